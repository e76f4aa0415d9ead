"""Transitions at rest between the phases of a plan, and the schedules of phases that hold the object.

Derivation: section 8 of `docs/derivation.md`.
"""

import itertools

import numpy as np

from wholearm_jax.core import Status, as_device_array
from wholearm_jax.margin import MarginBound
from wholearm_jax.model import Arrival, Phase, Scene, TorqueSchedule, uniform_schedule
from wholearm_jax.optimisation.rest_transition import (
    Moving,
    ReachableTorque,
    Resting,
    RestTransition,
    rest_transition,
)
from wholearm_jax.optimisation.strong_hold import strong_hold
from wholearm_jax.phases import TracedPhase, statics_at_start


def rest_transitions(
    scene: Scene,
    groups: list[list[int]],
    traced: tuple[TracedPhase, ...],
    bounds: tuple[MarginBound, ...],
    rate_limit: float,
    max_dwell: float,
    durations: tuple[float, float] | None,
) -> list[RestTransition | None]:
    """Find the torques between each group of phases and the next.

    Args:
        scene: the plan.
        groups: numbers of the phases that follow one another at speed.
        traced: of each phase.
        bounds: of each phase's margin.
        rate_limit: largest torque rate [N m/s].
        max_dwell: longest time for which the object may wait, as a fraction of the phase in which it then moves.
        durations: range of the durations [s], if they are free.

    Returns:
        One fewer than groups; None where a path or a positive bound is missing.
    """

    def duration(k):
        planned = float(scene.phases[k].duration)
        moves = scene.phases[k].arrive is not Arrival.HOLD
        return float(np.clip(planned, *durations)) if durations is not None and moves else planned

    def moving(k):
        return Moving(traced[k].dynamics, duration(k), float(bounds[k].value))

    def resting(k):
        return Resting(*statics_at_start(scene, scene.phases[k], traced[k]), float(bounds[k].value))

    def reachable(group, begin):
        if begin is None or not begin.is_feasible:
            return None
        time = sum(duration(k) for k in group) - begin.dwell_time
        return ReachableTorque(begin.departure_torque, rate_limit * time)

    def between(group, following, begin):
        last, first = group[-1], following[0]
        if any(int(traced[k].dynamics.status) != Status.OK or not float(bounds[k].value) > 0 for k in (last, first)):
            return None
        before = resting(last) if scene.phases[last].arrive is Arrival.HOLD else moving(last)
        onward = None if scene.phases[first].arrive is Arrival.HOLD else moving(first)
        return rest_transition(before, resting(first), onward, rate_limit, max_dwell, reachable(group, begin))

    transitions: list[RestTransition | None] = []
    for group, following in itertools.pairwise(groups):
        transitions.append(between(group, following, transitions[-1] if transitions else None))
    return transitions


def holding_schedule(
    scene: Scene,
    phase: Phase,
    traced: TracedPhase,
    knots: int,
    rate_limit: float | None = None,
    begin: RestTransition | None = None,
    end: RestTransition | None = None,
) -> TorqueSchedule:
    """Return the schedule of the best torque that holds the object, from time 0: one under which it must stay, if any.

    At a limited rate torques change linearly from that of the first transition to the best one, or as near to it as
    time allows, and on to that of the second. The margin is concave in the torque: it is least where a change ends.

    Args:
        scene: the plan.
        phase: the phase that holds the object.
        traced: its path.
        knots: rows of a schedule without rate limit.
        rate_limit: largest torque rate [N m/s]; None: unlimited.
        begin: the transition with which the phase begins.
        end: the one with which it ends.
    """
    duration = float(phase.duration)
    if int(traced.dynamics.status) != Status.OK:
        return uniform_schedule(duration, np.zeros((knots, 2)))
    best = strong_hold(scene, phase, traced, hand_over=None).static.torque
    if rate_limit is None:
        return uniform_schedule(duration, np.tile(best, (knots, 1)))
    first, last = (at.torque if at is not None and at.is_feasible else best for at in (begin, end))

    # Go as far from the last torque to the best one as the duration allows.
    def torque_towards_best(fraction):
        torque = last + fraction * (best - last)
        return torque, *(float(np.abs(torque - at).max()) / rate_limit for at in (first, last))

    def excess_time(fraction):
        return sum(torque_towards_best(fraction)[1:]) - duration

    fraction = 1.0
    if excess_time(1.0) > 0:
        from scipy.optimize import brentq  # imported here: it takes long to import

        fraction = brentq(excess_time, 0.0, 1.0) if excess_time(0.0) < 0 else 0.0
    torque, rise_time, return_time = torque_towards_best(fraction)

    # Of rows at one time the last stays.
    times = np.array([0.0, min(rise_time, duration), max(duration - return_time, rise_time), duration])
    stays = np.append(np.diff(times) > 0, True)
    rows = np.stack([first, torque, torque, last])
    return TorqueSchedule(as_device_array(times[stays]), as_device_array(rows[stays]))
