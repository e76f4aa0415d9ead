"""What met what in an execution: links that touch, joints at the ends of their ranges, and what of it was to be."""

# MuJoCo's names come from a compiled module, which type checkers cannot see into.
# pyright: reportAttributeAccessIssue=false

from collections.abc import Collection

import mujoco
import numpy as np

from wholearm_jax.core import as_device_array
from wholearm_jax.execution.mujoco_model import LINK_MEETINGS, MujocoModel
from wholearm_jax.model import link_overlaps, object_radius
from wholearm_jax.phases import Result

RANGE_TOL = 1e-6  # [rad] from the end of a joint's range, within which a phase ends there
TOUCH_TOL = 1e-6  # of the object's radius between links, within which they touch where a phase ends


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

    All are expected where a path ends at an obstacle. Otherwise a joint may reach its range where a phase ends, and
    links may touch there: a fingertip that slides along an edge down to the palm comes to a vertex and to the palm.
    """
    if any(bool(phase.traced.dynamics.ends_at_obstacle) for phase in prediction.phases):
        return set()
    scene = prediction.scene
    ends = np.array([phase.traced.end[3:] for phase in prediction.phases])
    reached = (np.abs(ends[..., None] - np.asarray(scene.hand.range)) < RANGE_TOL).any((0, 2))
    depths = np.array([link_overlaps(scene.hand, as_device_array(end))[:3] for end in ends])
    depths[:, 0] -= float(scene.hand.clearance)  # free bodies touch or do not
    touch = (depths > -TOUCH_TOL * object_radius(scene.object)).any(0)
    expected = {range_name(int(finger)) for finger in np.flatnonzero(reached)}
    return {*met} - expected - {LINK_MEETINGS[pair] for pair in np.flatnonzero(touch)}


def range_name(finger: int) -> str:
    """Name the meeting of a finger, 0 or 1, with the end of its joint's range."""
    return f"finger{finger + 1} reaches its range"
