"""The motion that a law follows: smooth from rest to rest, or that of a schedule."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from wholearm_jax.feedback.path_table import PathTable
from wholearm_jax.phases import Trajectory

TIMES = 101  # of a reference
SPEED_EXPONENTS = ((2, 2), (1, 1))  # exponents p, q of the speed u^p (1 - u)^q from rest to rest
PASSING = (0.25, 0.5, 1.0)  # speeds at changes of formation, over the mean speed of the phase before


class ReferenceMotion(NamedTuple):
    """Place [rad], speed [rad/s] and acceleration [rad/s^2] over the time since the phase began [s]."""

    time: Float[np.ndarray, "times"]
    s: Float[np.ndarray, "times"]
    v: Float[np.ndarray, "times"]
    a: Float[np.ndarray, "times"]


def smooth_motions(length: float, duration: float, slow: float = 0.0, approach: float = 0.0) -> list[ReferenceMotion]:
    """Return motions over a path's `length` [rad] with the speeds of `SPEED_EXPONENTS`.

    They begin at rest, and end at rest or, for the last part `slow` [rad] of the path, go on with the speed `approach`
    [rad/s].
    """
    return [_profile_motion(p, q, length, duration, slow, approach) for p, q in SPEED_EXPONENTS]


def _profile_motion(p: int, q: int, length: float, duration: float, slow: float, approach: float) -> ReferenceMotion:
    # Up to the slow part, at `fast` [s], the speed is a polynomial in u, with a part that rises to the approach's.
    fast = duration - slow / approach if slow > 0 else duration
    rise = np.polynomial.Polynomial([0.0, 0.0, 3.0, -2.0]) * (approach * fast if slow > 0 else 0.0)
    bump = np.polynomial.Polynomial([0.0] * p + [1.0]) * np.polynomial.Polynomial([1.0, -1.0]) ** q
    unit = (length - slow - rise.integ()(1.0)) / bump.integ()(1.0)
    time, last = np.linspace(0.0, duration, TIMES), approach if slow > 0 else 0.0
    return _then_slowly((unit * bump + rise).integ(), fast, last, time, time >= fast)


def passing_motion(
    length: float, duration: float, entry: float, exit_: float, slow: float = 0.0, approach: float = 0.0
) -> ReferenceMotion:
    """Return the motion over a path's `length` [rad] with given speeds [rad/s] at both ends.

    Its place is cubic in time; for the last part `slow` [rad] of the path it goes on with the speed `approach` [rad/s].
    """
    fast, far = (duration - slow / approach, length - slow) if slow > 0 else (duration, length)
    last = approach if slow > 0 else exit_
    entry, leaves = (min(v * fast, 2.9 * far) for v in (entry, last))  # so that it never goes back
    cubic = np.polynomial.Polynomial([0.0, entry, 3 * far - 2 * entry - leaves, entry + leaves - 2 * far])
    time = np.linspace(0.0, duration, TIMES)
    constant = time > fast
    constant[-1] = slow > 0 or exit_ == 0  # else it comes to the end as it goes on in the next phase
    return _then_slowly(cubic, fast, last, time, constant)


def _then_slowly(
    place: np.polynomial.Polynomial,
    fast: float,
    speed: float,
    time: Float[np.ndarray, "times"],
    constant: Bool[np.ndarray, "times"],
) -> ReferenceMotion:
    """Return a motion whose place is a polynomial in the share of `fast` [s], then goes on with one `speed` [rad/s].

    At times that are `constant` it is not braked any more.
    """
    u, beyond = np.minimum(time / fast, 1.0), np.maximum(time - fast, 0.0)
    v = np.where(constant, speed, place.deriv()(u) / fast)
    a = np.where(constant, 0.0, place.deriv(2)(u) / fast**2)
    return ReferenceMotion(time, place(u) + speed * beyond, v, a)


def scheduled_motion(table: PathTable, course: Trajectory) -> ReferenceMotion:
    """Return the motion of a simulated phase."""
    rows = np.linspace(0, len(course.time) - 1, TIMES).round().astype(int)
    time = np.asarray(course.time)[rows] - float(course.time[0])
    place = np.interp(np.asarray(course.s)[rows], table.parameter, table.s)
    speed = np.hypot(*np.asarray(course.z_dot)[rows, 3:].T)
    acceleration = np.gradient(speed, time, edge_order=2)
    acceleration[-1] *= speed[-1] > 0
    return ReferenceMotion(time, place, speed, acceleration)
