"""Differentiable dynamics and torque-trajectory optimisation for planar whole-arm manipulation.

Read the modules in this order: `scene`, `contact_set`, `scaled_mechanics`, `solve_on_path`, `rest_margin`, `trace_curve`, `start`, `places` and `path`
(trace), `reduction` (reduce), `schedule`, `stepping`, `landing` and `motion` (simulate), `forces` (score), `assessment`,
`phase`, `result` and `plan`, `squeeze` (quasi-static torques and the bound), `shooting`, `linearisation`, `recursion`,
`descent`, `pacing`, `initial_guesses` and `optimiser` (optimise), `baseline` (the paper's search), `variation` and `batch`
(many scenes at once), `build_mujoco_model`, `coulomb`, `execution` and `perturbation` (virtual hardware).
"""

from wholearm_jax.core import Status, configure
from wholearm_jax.ensembles import check
from wholearm_jax.files import load, parse, read_torque, save, write_torque
from wholearm_jax.model import Scene, TorqueSchedule, torque_schedule
from wholearm_jax.optimisation import bounds, optimise, quasistatic, search_by_steps
from wholearm_jax.phases import margin, simulate, trace, trajectory
from wholearm_jax.simulation import IntegratorOptions

__all__ = [
    "IntegratorOptions",
    "Scene",
    "Status",
    "TorqueSchedule",
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
    "search_by_steps",
    "simulate",
    "torque_schedule",
    "trace",
    "trajectory",
    "write_torque",
]
