"""Differentiable dynamics and torque-trajectory optimisation for planar whole-arm manipulation.

Read the modules in this order: `scene`, `contacts`, `system`, `newton`, `watch`, `march`, `start`, `places` and `wire`
(trace), `reduction` (reduce), `schedule`, `stepping`, `landing` and `motion` (simulate), `forces` (score), `verdict`,
`phase`, `result` and `plan`, `squeeze` (quasi-static torques and the bound), `shooting`, `linearisation`, `recursion`,
`descent`, `pacing`, `guesses` and `optimiser` (optimise), `baseline` (the paper's search), `variation` and `batch`
(many scenes at once), `free_bodies`, `coulomb`, `execution` and `perturbation` (virtual hardware).
"""

from wholearm_jax.baseline import search
from wholearm_jax.batch import check
from wholearm_jax.optimiser import bounds, optimise, quasistatic
from wholearm_jax.plan import margin, simulate, trace
from wholearm_jax.result_file import read_torque, write_torque
from wholearm_jax.sampling import trajectory
from wholearm_jax.scene import Scene
from wholearm_jax.scene_file import load, parse, save
from wholearm_jax.schedule import Torque, torque
from wholearm_jax.settings import configure
from wholearm_jax.status import Status
from wholearm_jax.stepping import Integration

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
