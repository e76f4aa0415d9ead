"""Differentiable dynamics and torque-trajectory optimisation for planar whole-arm manipulation.

Read the modules in this order: `scene`, `contact_set`, `scaled_mechanics`, `solve_on_path`, `rest_margin`, `trace_curve`, `start`, `places` and `wire`
(trace), `reduction` (reduce), `schedule`, `stepping`, `landing` and `motion` (simulate), `forces` (score), `verdict`,
`phase`, `result` and `plan`, `squeeze` (quasi-static torques and the bound), `shooting`, `linearisation`, `recursion`,
`descent`, `pacing`, `initial_guesses` and `optimiser` (optimise), `baseline` (the paper's search), `variation` and `batch`
(many scenes at once), `build_mujoco_model`, `coulomb`, `execution` and `perturbation` (virtual hardware).
"""

from wholearm_jax.core.config import configure
from wholearm_jax.core.status import Status
from wholearm_jax.ensembles.batch import check_batch
from wholearm_jax.files.results import read_torque, write_torque
from wholearm_jax.files.scene_toml import load, parse, save
from wholearm_jax.model.scene import Scene
from wholearm_jax.model.schedule import TorqueSchedule, torque_schedule
from wholearm_jax.optimisation.optimiser import bounds, optimise, quasistatic
from wholearm_jax.optimisation.step_search import search_by_steps
from wholearm_jax.phases.plan import margin, simulate, trace
from wholearm_jax.phases.sampling import trajectory
from wholearm_jax.simulation.integrator import IntegratorOptions

__all__ = [
    "Integration",
    "Scene",
    "Status",
    "Torque",
    "bounds",
    "check",
    "configure",
    "load",
    "margin",
    "optimise",
    "parse",
    "quasistatic",
    "read_torque",
    "save",
    "search",
    "simulate",
    "torque",
    "trace",
    "trajectory",
    "write_torque",
]
