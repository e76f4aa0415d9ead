"""What a schedule's torques do at hand-overs by the contact that is not planned.

An object that comes to a hand-over a moment early is stopped by the contact that takes over; one that comes late, or
not quite there, is started by the contact that ends. The simulation, which is never early or late, sees neither.
"""

import itertools
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from wholearm_jax.core import Status
from wholearm_jax.margin import schedule_corners
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
    overs = find_hand_overs(result.scene, traced)[1:]
    for (last, phase), over in zip(itertools.pairwise(result.phases), overs, strict=True):
        if over is None:
            continue
        begin = phase.start
        departs = max([begin, *(held.end for held in phase.holds if held.start <= begin)])
        stopping = schedule_corners(result.torque, last.start, begin)[1][-1]
        starting = schedule_corners(result.torque, departs, begin + phase.duration)[1][0]
        for stops, time, torque, planned, other in (
            (True, begin, stopping, over.before, over.after),
            (False, departs, starting, over.after, over.before),
        ):
            force, acceleration = _motion(other, torque)
            if force < 0 or (stops and acceleration >= 0):
                found.append(OneSidedTorque(time, stops, planned.name, other.name, force))
    return tuple(found)


def _motion(one: OneContact, torque: Float[np.ndarray, "2"]) -> tuple[float, float]:
    """Return the least force [N] and the acceleration of an object that moves ahead, held by a contact."""
    row = np.append(1.0, torque)
    return float((one.slack @ row).min()), float(one.accelerations.ahead @ row)
