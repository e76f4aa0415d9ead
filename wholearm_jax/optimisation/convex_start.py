"""Where the descent starts: the convex optimum of a phase, and how long the object should move.

A phase that may take much longer than its optimum needs moves for a part of its duration only, and waits before, held
by friction, where the object must stay (`strong_hold`) and the contacts hold it with no smaller margin than in motion.
Where they hold it with less, that is tried if the whole duration is too much: small errors grow exponentially in the
time of a motion.

Derivation: section 8 of `docs/derivation.md`.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from wholearm_jax.core import as_device_array
from wholearm_jax.margin import PathOptimum, rest_to_rest
from wholearm_jax.model import Phase, Scene, TorqueSchedule, concatenate_schedules, torque_schedule
from wholearm_jax.optimisation.best_motion import largest_margin, shortest_duration
from wholearm_jax.optimisation.initial_guess import UnitMotion
from wholearm_jax.optimisation.quasistatic_plan import rolling_count
from wholearm_jax.optimisation.strong_hold import strong_hold
from wholearm_jax.phases import HandOver, TracedPhase

NEAR_MARGIN = 0.999  # fraction of the largest margin that the shortest sensible motion reaches
GOOD_MOVING_TIME = 1.25  # time of a motion after a wait, over the shortest sensible one
MAX_MOVING_TIME = 6.0  # longest motion without a wait, over the shortest sensible one; knots resolve no longer one


class Wait(NamedTuple):
    """The object waits, held by friction, before it moves."""

    time: float  # [s]
    torque: Float[np.ndarray, "2"]  # [N m]
    margin: float  # of the contacts that hold it [N]


class ConvexStart(NamedTuple):
    """The convex optimum of a phase from rest to rest."""

    motion: UnitMotion  # at evenly spaced knots
    wait: Wait | None  # None: the object moves at once


def convex_starts(
    scene: Scene,
    phase: Phase,
    traced: TracedPhase,
    duration: float,
    knots: int,
    may_wait: bool,
    hand_over: HandOver | None = None,
) -> list[ConvexStart]:
    """Solve the convex programme of one phase from rest to rest.

    Args:
        scene: the plan.
        phase: one of its phases.
        traced: its path.
        duration: of the phase [s].
        knots: torque knots of the phase.
        may_wait: whether the object may wait before it moves.
        hand_over: with which the phase begins, if it does: either contact must hold an object that waits.

    Returns:
        The starts to try in turn: moving for the whole duration unless that is very long, then after a wait where there
        is time and the object can be held. None where no motion from rest to rest takes so little time.
    """
    rest, dynamics, rolling = rest_to_rest(), traced.dynamics, rolling_count(phase)

    def optimum(time: float) -> PathOptimum:
        return largest_margin(dynamics, as_device_array(time), rest, rolling)

    whole = optimum(duration)
    if not bool(whole.converged):
        return []
    starts = [ConvexStart(_unit_motion(whole, traced, knots), None)]
    if not may_wait:
        return starts
    near = as_device_array(NEAR_MARGIN * float(whole.margin))
    sensible = shortest_duration(dynamics, near, rest, rolling)
    moving = GOOD_MOVING_TIME * float(sensible.duration)
    if not bool(sensible.converged) or duration <= moving:
        return starts
    hold = strong_hold(scene, phase, traced, hand_over)
    if hold is None:
        return starts
    wait = Wait(duration - moving, hold.torque, hold.margin)
    waiting = ConvexStart(_unit_motion(optimum(moving), traced, knots), wait)
    is_long = duration > MAX_MOVING_TIME * float(sensible.duration)
    return [waiting] if is_long and hold.margin >= float(whole.margin) else [*starts, waiting]


def wait_before(wait: Wait, schedule: TorqueSchedule) -> TorqueSchedule:
    """Return a schedule that holds the object first, and then steps to the given one."""
    held = torque_schedule([0.0, wait.time], [wait.torque, wait.torque])
    return concatenate_schedules([held, schedule])


def _unit_motion(optimum: PathOptimum, traced: TracedPhase, knots: int) -> UnitMotion:
    """Sample an optimum at even times: place, speed and acceleration over unit length and time."""
    time, s, v = (np.asarray(a) for a in (optimum.time, optimum.node_s, optimum.speed))
    (begin, length), duration = traced.dynamics.range(), time[-1]
    u = np.linspace(0.0, 1.0, knots)

    # The speed is linear in time within an interval: the place is quadratic.
    k = np.clip(np.searchsorted(time, u * duration, side="right") - 1, 0, len(time) - 2)
    x = (u * duration - time[k]) / (time[k + 1] - time[k])
    covered = (v[k] * x + (v[k + 1] - v[k]) * x**2 / 2) / ((v[k] + v[k + 1]) / 2)
    place = (s[k] + covered * (s[k + 1] - s[k]) - begin) / length
    speed = (v[k] + (v[k + 1] - v[k]) * x) * duration / length
    return place, speed, np.gradient(speed, u)
