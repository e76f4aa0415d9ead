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
from wholearm_jax.margin import PathOptimum, largest_margin, rest_to_rest, shortest_duration
from wholearm_jax.model import Phase, Scene, TorqueSchedule, concatenate_schedules, torque_schedule
from wholearm_jax.optimisation.initial_guess import UnitMotion
from wholearm_jax.optimisation.quasistatic_plan import rolling_count
from wholearm_jax.optimisation.strong_hold import strong_hold
from wholearm_jax.phases import HandOver, TracedPhase

NEAR_MARGIN = 0.999  # fraction of the largest margin that the shortest sensible motion reaches
HURRIED_MARGIN = 0.99  # the same of a hurried one, which has less time for errors to grow
GOOD_MOVING_TIME = 1.25  # time of a motion after a wait, over the shortest sensible one
MAX_MOVING_TIME = 6.0  # longest motion without a wait, over the shortest sensible one; knots resolve no longer one


class Wait(NamedTuple):
    """The object waits, held by friction, before it moves."""

    time: float  # [s]
    torque: Float[np.ndarray, "2"]  # [N m]
    margin: float  # of the contacts that hold it [N]
    is_strong: bool  # whether it must stay (`strong_hold`)


class ConvexStart(NamedTuple):
    """The convex optimum of a phase from rest to rest."""

    motion: UnitMotion  # at evenly spaced knots
    wait: Wait | None  # None: the object moves at once


class StartOptions(NamedTuple):
    """What the starts of one phase are found for."""

    scene: Scene
    phase: Phase
    traced: TracedPhase
    duration: float  # of the phase [s]
    knots: int  # of its torque
    hand_over: HandOver | None  # with which it begins, if it does: either contact must hold an object that waits

    def optimum(self, time: float) -> PathOptimum:
        """The motion of so much time with the largest margin."""
        rolling = rolling_count(self.phase)
        return largest_margin(self.traced.dynamics, as_device_array(time), rest_to_rest(), rolling)

    def start(self, optimum: PathOptimum, wait: Wait | None) -> ConvexStart:
        """A motion, after a wait or not."""
        return ConvexStart(_unit_motion(optimum, self.traced, self.knots), wait)


def convex_starts(options: StartOptions, may_wait: bool) -> list[ConvexStart]:
    """Solve the convex programme of one phase from rest to rest.

    Args:
        options: of the phase.
        may_wait: whether the object may wait before it moves.

    Returns:
        The starts to try in turn: moving for the whole duration unless that is very long, then after a wait where there
        is time and the object can be held. None where no motion from rest to rest takes so little time.
    """
    whole = options.optimum(options.duration)
    if not bool(whole.converged):
        return []
    starts = [options.start(whole, None)]
    sensible = _shortest_time(options, NEAR_MARGIN * float(whole.margin)) if may_wait else np.inf
    waiting = _after_wait(options, GOOD_MOVING_TIME * sensible)
    if waiting is None or waiting.wait is None:
        return starts
    is_long = options.duration > MAX_MOVING_TIME * sensible
    return [waiting] if is_long and waiting.wait.margin >= float(whole.margin) else [*starts, waiting]


def hurried_start(options: StartOptions) -> ConvexStart | None:
    """Return the start with a wait and a shorter motion yet, for a phase whose other motions need too exact torques."""
    whole = options.optimum(options.duration)
    return _after_wait(options, _shortest_time(options, HURRIED_MARGIN * float(whole.margin)))


def _shortest_time(options: StartOptions, margin: float) -> float:
    """The shortest time of a motion with a margin [N], in seconds; infinite where none was found."""
    rolling = rolling_count(options.phase)
    found = shortest_duration(options.traced.dynamics, as_device_array(margin), rest_to_rest(), rolling)
    return float(found.duration) if bool(found.converged) else np.inf


def _after_wait(options: StartOptions, moving: float) -> ConvexStart | None:
    """A motion of so much time after a wait; None where there is no time for that, or nothing holds the object."""
    if options.duration <= moving:
        return None
    hold = strong_hold(options.scene, options.phase, options.traced, options.hand_over)
    if not hold.static.margin > 0:
        return None
    wait = Wait(options.duration - moving, hold.static.torque, hold.static.margin, hold.is_strong)
    return options.start(options.optimum(moving), wait)


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
