"""What a schedule's torques do at hand-overs by the contact that is not planned.

An object that comes to a hand-over a moment early is stopped by the contact that takes over; one that comes late, or
not quite there, is started by the contact that ends. The simulation, which is never early or late, sees neither.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from wholearm_jax.core import Status
from wholearm_jax.model import TorqueSchedule
from wholearm_jax.phases.hand_overs import OneContact, find_hand_overs
from wholearm_jax.phases.result import Result


class OneSidedTorque(NamedTuple):
    """Torques that move the object as planned by one contact of a hand-over, and not by the other."""

    time: float  # [s]
    stops: bool  # whether they are to stop the object, or to start it
    planned: str  # the contact by which they do
    other: str  # and that by which they do not
    force: float  # least while it moves on by the other contact [N]; not negative: they do not brake it there


def one_sided_torques(result: Result) -> tuple[OneSidedTorque, ...]:
    """Return where a simulated plan's torques stop or start the object at a hand-over by the planned contact alone.

    Args:
        result: a simulated plan; of one that is not `ok` nothing is returned.

    Returns:
        In the order of time; empty where an object may come to every hand-over a little early or late.
    """
    if result.status is not Status.OK:
        return ()
    found = []
    traced = tuple(phase.traced for phase in result.phases)
    for phase, over in zip(result.phases, find_hand_overs(result.scene, traced), strict=True):
        if over is None:
            continue
        start = max([phase.start, *(held.end for held in phase.holds if held.start <= phase.start)])
        for stops, time, planned, other in (
            (True, phase.start, over.before, over.after),
            (False, start, over.after, over.before),
        ):
            force, acceleration = _motion(other, _torque_beside(result.torque, time, before=stops))
            if force < 0 or (stops and acceleration >= 0):
                found.append(OneSidedTorque(time, stops, planned.name, other.name, force))
    return tuple(found)


def _motion(one: OneContact, torque: Float[np.ndarray, "2"]) -> tuple[float, float]:
    """Return the least force [N] and the acceleration of an object that moves ahead, held by a contact."""
    row = np.append(1.0, torque)
    return float((one.slack @ row).min()), float(one.accelerations.ahead @ row)


def _torque_beside(schedule: TorqueSchedule, time: float, *, before: bool) -> Float[np.ndarray, "2"]:
    """Return a schedule's torque just before or just after a time [s], where it may step."""
    times, values = np.asarray(schedule.times), np.asarray(schedule.values)
    near = abs(times - time) <= 1e-9 * times[-1]
    if near.any():
        rows = np.flatnonzero(near)
        return values[rows[0] if before else rows[-1]]
    return np.array([np.interp(time, times, column) for column in values.T])
