"""Differentiable dynamics and torque-trajectory optimisation for planar whole-arm manipulation.

Read the folders in this order: `core`, `model` (what a scene is), `tracing` (the path of a contact formation),
`dynamics` (the equations of motion along it), `simulation`, `margin` (contact forces and their minimum), `phases` (one
after the other), `optimisation`, `planning`, `ensembles` (many scenes), `execution` (virtual hardware), `files`,
`plotting`, `report` and `cli`. Each imports only from those above it.
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
