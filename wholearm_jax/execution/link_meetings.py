"""What met what in an execution: links that touch, joints at the ends of their ranges, and what of it was to be."""

# MuJoCo's names come from a compiled module, which type checkers cannot see into.
# pyright: reportAttributeAccessIssue=false

from collections.abc import Collection

import mujoco
import numpy as np

from wholearm_jax.execution.mujoco_model import MujocoModel
from wholearm_jax.phases import Result

RANGE_TOL = 1e-6  # [rad] from the end of a joint's range, within which a phase ends there


def record_meetings(bodies: MujocoModel, data: mujoco.MjData, time: float, met: dict[str, float]) -> None:
    """Note the time of links that touch for the first time, and of joints at the ends of their ranges."""
    geom = data.contact.geom
    if len(geom):
        rows = bodies.pair[geom[:, 0], geom[:, 1]] - len(bodies.names)
        for row in rows[rows >= 0]:
            met.setdefault(bodies.link_meetings[row], time)
    if data.nl:
        beyond = (data.qpos[3:] < bodies.model.jnt_range[3:, 0]) | (data.qpos[3:] > bodies.model.jnt_range[3:, 1])
        for finger in np.flatnonzero(beyond):
            met.setdefault(range_name(int(finger)), time)


def unexpected_meetings(prediction: Result, met: Collection[str]) -> set[str]:
    """Return those of the links that met, and of the ranges that ended, with which no phase of a prediction ends.

    All are expected where a path ends at an obstacle. Otherwise a joint may reach its range where a phase ends.
    """
    if any(bool(phase.traced.dynamics.ends_at_obstacle) for phase in prediction.phases):
        return set()
    ends = np.array([phase.traced.end[3:] for phase in prediction.phases])
    reached = (np.abs(ends[..., None] - np.asarray(prediction.scene.hand.range)) < RANGE_TOL).any((0, 2))
    return {*met} - {range_name(int(finger)) for finger in np.flatnonzero(reached)}


def range_name(finger: int) -> str:
    """Name the meeting of a finger, 0 or 1, with the end of its joint's range."""
    return f"finger{finger + 1} reaches its range"
