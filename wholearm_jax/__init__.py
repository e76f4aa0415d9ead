"""Differentiable dynamics and torque-trajectory optimisation for planar whole-arm manipulation.

Read the folders in this order: `core`, `model` (what a scene is), `tracing` (the path of a contact formation),
`dynamics` (the equations of motion along it), `simulation`, `margin` (contact forces and their minimum), `phases` (one
after the other), `optimisation`, `planning`, `feedback`, `ensembles` (many scenes), `execution` (virtual hardware),
`files`, `plotting`, `report` and `cli`. Each imports only from those above it.
"""

import warnings
from typing import TYPE_CHECKING

import wholearm_jax.cli.interruption  # noqa: F401, first: a command may be interrupted while the rest is imported
from wholearm_jax.core import Status, configure, keep_compiled
from wholearm_jax.ensembles import check
from wholearm_jax.feedback import Controller, feedback
from wholearm_jax.files import (
    load,
    load_goal,
    load_start,
    parse,
    parse_start,
    read_controller,
    read_outline,
    read_torque,
    save,
    scene_from_outline,
    write_controller,
    write_torque,
)
from wholearm_jax.model import Scene, TorqueSchedule, torque_schedule
from wholearm_jax.optimisation import (
    bounds,
    convex_bounds,
    optimise,
    quasistatic,
    search_by_steps,
    shortest_motions,
)
from wholearm_jax.phases import margin, simulate, torque_accuracy, trace, trajectory
from wholearm_jax.planning import plan, plan_with_hand
from wholearm_jax.simulation import IntegratorOptions

__all__ = [
    "Controller",
    "IntegratorOptions",
    "Scene",
    "Status",
    "TorqueSchedule",
    "bounds",
    "check",
    "configure",
    "convex_bounds",
    "feedback",
    "keep_compiled",
    "load",
    "load_goal",
    "load_start",
    "margin",
    "optimise",
    "parse",
    "parse_start",
    "plan",
    "plan_with_hand",
    "quasistatic",
    "read_controller",
    "read_outline",
    "read_torque",
    "save",
    "scene_from_outline",
    "search_by_steps",
    "shortest_motions",
    "simulate",
    "torque_accuracy",
    "torque_schedule",
    "trace",
    "trajectory",
    "write_controller",
    "write_torque",
]

# Names of the root before the package was laid out in folders; CHANGELOG.md has the same table, and the others.
_RENAMED = {
    "Integration": "IntegratorOptions",
    "Torque": "TorqueSchedule",
    "search": "search_by_steps",
    "torque": "torque_schedule",
}

if not TYPE_CHECKING:  # a type checker should refuse names that do not exist

    def __getattr__(name: str):
        """Return what an old name stands for, with a warning that gives the new one."""
        if name not in _RENAMED:
            raise AttributeError(f"module 'wholearm_jax' has no attribute {name!r}")
        new = _RENAMED[name]
        warnings.warn(f"wholearm_jax.{name} is now wholearm_jax.{new} (CHANGELOG.md)", FutureWarning, stacklevel=2)
        return globals()[new]
