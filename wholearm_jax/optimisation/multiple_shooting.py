r"""Shoot: one phase cut at its torque knots, every interval simulated from a state that is a variable itself.

The variables of direct multiple shooting are the torques at the knots and the states `(s, v)` there. An interval's
simulation ends in a state that must equal the next variable; these *defects* vanish at the solution, and the intervals
together are then the simulation of the phase. Because each interval is short, its end depends on its beginning almost
linearly, even where the motion as a whole is unstable or starts after a long dwell, and its derivatives are those with
respect to seven numbers, whatever the number of knots.

An interval is a small phase of its own: time is a share of the interval and `w` the speed in `s` per interval. Where it
crosses from one piece of the wire to the next (`path`), it is cut exactly there. States may pass rest and the wire's
end: the forces continue smoothly there, and only an honest simulation (`motion`) decides what happens.

Source of the method: H. G. Bock and K. J. Plitt, A multiple shooting algorithm for direct solution of optimal control
problems, IFAC World Congress 1984.

Derivation: section 9 of `docs/derivation.md`.
"""

import functools
import math
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float, Int

from wholearm_jax.core import take_row
from wholearm_jax.dynamics import PathDynamics, differentiate_polynomial
from wholearm_jax.margin import MAX_ROLLING, DenseOutput, cone_facets, quintic_hermite, sampled_slacks
from wholearm_jax.model import PhaseSchedule
from wholearm_jax.simulation import IntegratorOptions, path_acceleration, solver_step

ONE_STEP = 50  # intervals of a phase from which one solver step in each serves; fewer take two
ROWS = 4 + MAX_ROLLING  # slacks a sample
SPACES = 8  # between the places of an interval at which forces are sampled
SPARE = 3  # times that a phase's intervals may be cut beyond once in each of its wire's pieces, as by going back
HALF = 4  # numbers that bound the speed from below in half of an interval
SPEED_COEFFICIENTS = 2 * HALF
MAX_KINK_ITERATIONS = 30  # most Newton steps to the place where an interval is cut
KINK_TOL = 1e-8  # size of the last one; what is left is taken to first order, an error of its square


class Variables(eqx.Module):
    """What is optimised, for one phase or several that follow one another at speed: torques at the knots in units of
    their limits, states `(s, v)` at the knots in wire lengths from the wire's start and wire lengths a duration, and
    the logarithms of the durations [s]."""

    torque: Float[Array, "phases knots 2"]
    state: Float[Array, "phases knots 2"]
    log_duration: Float[Array, "phases"]


def steps_of(intervals: int) -> int:
    """Solver steps in each interval of a phase, and in each part of one that is cut."""
    return 1 if intervals >= ONE_STEP else 2


def samples_of(intervals: int) -> int:
    """Forces sampled in each: evenly, both ends of every step included."""
    return SPACES + steps_of(intervals)


def extra_parts(dynamics: PathDynamics) -> int:
    """Room for the parts behind the first ones of all intervals of a phase together."""
    return dynamics.speed_ratio.shape[-1] + SPARE


class Samples(NamedTuple):
    """What was sampled in a part of an interval: forces' slacks [N] (`forces.cone_facets`), the samples' shares of
    the phase (0: none), and speeds (`_speed_lower_bounds`) in wire lengths a duration with their shares."""

    forces: Float[Array, "*parts samples rows"]
    weight: Float[Array, "*parts samples"]
    pace: Float[Array, "*parts paces"]
    pace_weight: Float[Array, "*parts paces"]


class IntervalResults(NamedTuple):
    """Intervals simulated: all their parts, in which interval each lies (`interval_of_part`), and the states at the
    intervals'
    ends as in `Variables`. Part `k` is the first one of interval `k`; behind the intervals' number is one for each
    piece of the wire that an interval comes into, and then those that come into a piece once more."""

    parts: Samples
    interval_of_part: Int[Array, "parts"]
    end: Float[Array, "intervals 2"]


def interval_inputs(p: Variables) -> Float[Array, "phases intervals 7"]:
    """What each interval depends on: `s`, `v`, two torques at either end, log of the duration."""
    spread = jnp.broadcast_to(p.log_duration[:, None, None], (*p.torque[:, 1:].shape[:2], 1))
    return jnp.concatenate([p.state[:, :-1], p.torque[:, :-1], p.torque[:, 1:], spread], axis=2)


class _PartState(NamedTuple):
    """An interval on its way: where it has come to, and whether one part is behind it; each lies in one piece."""

    phase_time: Float[Array, "*intervals"]
    y: Float[Array, "*intervals 2"]
    segment: Int[Array, "*intervals"]
    begun: Bool[Array, "*intervals"]


def simulate_intervals(
    dynamics: PathDynamics, options: IntegratorOptions, intervals: int, q: Float[Array, "cut 7"]
) -> IntervalResults:
    """Simulate intervals of a phase, which as a whole has `intervals`.

    Where together they are cut more often than there is room for (`extra_parts`), or a cut is not found, they end in
    NaN.
    """
    cut, room = q.shape[0], q.shape[0] + extra_parts(dynamics)
    segments = dynamics.speed_ratio.shape[-1]
    begin = jax.vmap(lambda q: _interval_start(dynamics, intervals, q))(q)
    begun, firsts = jax.vmap(partial(_simulate_whole, dynamics, options, intervals))(begin, q)
    parts = jax.tree.map(lambda a: jnp.zeros((room, *a.shape[1:]), a.dtype).at[:cut].set(a), firsts)
    owner = jnp.minimum(jnp.arange(room), cut - 1)

    def going(state):
        at, *_, spare = state
        return jnp.any(at.phase_time < 1) & (spare < room)

    def next_part(state):
        """Most intervals have one part: the others go one part at a time."""
        at, parts, owner, come, spare = state
        k = jnp.argmax(at.phase_time < 1)
        one = jax.tree.map(lambda a: take_row(a, k), at)
        after, samples = _simulate_to_kink(dynamics, options, intervals, one, take_row(q, k))
        again = take_row(come, one.segment)
        row = jnp.where(one.begun, jnp.where(again, spare, cut + one.segment), k)
        at = jax.tree.map(lambda a, new: a.at[k].set(new), at, after)
        parts = jax.tree.map(lambda a, new: a.at[row].set(new), parts, samples)
        come = come.at[one.segment].set(again | one.begun)
        return at, parts, owner.at[row].set(k), come, spare + (one.begun & again)

    start = begun, parts, owner, jnp.zeros(segments, bool), jnp.asarray(cut + segments)
    done, parts, owner, *_ = jax.lax.while_loop(going, next_part, start)
    y = jnp.where((done.phase_time < 1)[:, None], jnp.nan, done.y)
    end = jnp.stack([y[:, 0] - dynamics.breakpoints[0], y[:, 1] * intervals], axis=1) / dynamics.length
    return IntervalResults(parts, owner, end)


def _interval_start(dynamics: PathDynamics, intervals: int, q: Float[Array, "7"]) -> _PartState:
    """Where an interval begins."""
    y = jnp.stack([dynamics.breakpoints[0] + dynamics.length * q[0], dynamics.length / intervals * q[1]])
    real = jnp.arange(dynamics.breakpoints.shape[0]) < dynamics.count
    segment = jnp.maximum(((stop_gradient(y[0]) >= dynamics.breakpoints) & real).sum() - 1, 0)
    return _PartState(jnp.zeros(()), y, segment, jnp.asarray(False))


def _simulate_whole(
    dynamics: PathDynamics, options: IntegratorOptions, intervals: int, at: _PartState, q: Float[Array, "7"]
) -> tuple[_PartState, Samples]:
    """To the interval's end, within the piece that it begins in; one that comes past that piece's end does not set
    out."""
    phase_schedule, duration = _schedule(dynamics, intervals, q)
    when, place = _steps(dynamics, phase_schedule, duration, options, at, 1.0, steps_of(intervals))
    past = place[-1, 0] > _goal(dynamics, at.segment)
    ended = _PartState(jnp.ones_like(at.phase_time), place[-1], at.segment, jnp.asarray(True))
    after = jax.tree.map(lambda stay, go: jnp.where(past, stay, go), at, ended)
    return after, _sampled(dynamics, phase_schedule, duration, intervals, when, place, at.segment)


def _simulate_to_kink(
    dynamics: PathDynamics, options: IntegratorOptions, intervals: int, at: _PartState, q: Float[Array, "7"]
) -> tuple[_PartState, Samples]:
    """To the interval's end, or the end of the piece."""
    phase_schedule, duration = _schedule(dynamics, intervals, q)
    when, place, onward = _to_break(dynamics, phase_schedule, duration, options, at, steps_of(intervals))
    factor = dynamics.speed_ratio[jnp.minimum(at.segment + 1, dynamics.speed_ratio.shape[0] - 1)]
    after = _PartState(
        phase_time=jnp.where(onward, when[-1], 1.0),
        y=place[-1] * jnp.where(onward, jnp.stack([jnp.ones_like(factor), factor]), 1.0),
        segment=at.segment + onward,
        begun=jnp.asarray(True),
    )
    return after, _sampled(dynamics, phase_schedule, duration, intervals, when, place, at.segment)


def _schedule(dynamics: PathDynamics, intervals: int, q: Float[Array, "7"]) -> tuple[PhaseSchedule, Float[Array, ""]]:
    """An interval's torques, and how long it lasts."""
    values, zero = q[2:6].reshape(2, 2) * dynamics.torque_limit, jnp.zeros((), int)
    return PhaseSchedule(jnp.arange(2.0), values, values[1:] - values[:-1], zero, zero), jnp.exp(q[6]) / intervals


def _goal(dynamics: PathDynamics, segment) -> Float[Array, ""]:
    """Where a piece ends for intervals: the last one nowhere."""
    return jnp.where(segment >= dynamics.count - 1, jnp.inf, dynamics.breakpoints[segment + 1])


def _sampled(
    dynamics: PathDynamics, phase_schedule: PhaseSchedule, duration, intervals: int, when, place, segment
) -> Samples:
    """Forces and speeds of a part."""
    count, samples = steps_of(intervals), samples_of(intervals)
    steps = _arcs(dynamics, phase_schedule, duration, when, place, segment)
    forces = sampled_slacks(dynamics, phase_schedule, duration, steps, samples // count, cone_facets).reshape(
        samples, -1
    )
    span = stop_gradient(when[-1] - when[0]) / intervals
    weight, pace_weight = (jnp.full(each, span / each) for each in (samples, SPEED_COEFFICIENTS))
    forces = jnp.where(span > 0, forces, 0.0)
    return Samples(forces, weight, _speed_lower_bounds(steps) / (dynamics.length / intervals), pace_weight)


def _arcs(dynamics: PathDynamics, phase_schedule: PhaseSchedule, duration, when, place, segment) -> DenseOutput:
    """A part's steps."""
    phase_time, s, w = (jnp.stack([a[:-1], a[1:]], axis=1) for a in (when, place[:, 0], place[:, 1]))
    count = phase_time.shape[0]
    segments, row = jnp.broadcast_to(segment, count), jnp.zeros(count, int)
    live = phase_time[:, 1] > phase_time[:, 0]
    quintic = jax.vmap(quintic_hermite, (None, None, None, 0, 0, 0, 0, 0, 0))(
        dynamics, phase_schedule, duration, phase_time, s, w, segments, row, live
    )
    return DenseOutput(phase_time, quintic, segments, row, jnp.zeros(count, bool), live)


def _speed_lower_bounds(steps: DenseOutput) -> Float[Array, "paces"]:
    """What bounds the speed in each half from below: while all are positive, it is nowhere less than the least.

    They are the coefficients, but the last, of `ds/dxi` by Bernstein's polynomials: the first is the speed where the
    half begins, the last that where the next one does. Speeds at some places alone would let it fall below zero between
    them, where an honest simulation stops.
    """
    width = steps.phase_time[:, 1] - steps.phase_time[:, 0]
    slopes = jax.vmap(differentiate_polynomial)(steps.quintic) @ _bernstein(SPEED_COEFFICIENTS // HALF // width.size).T
    return jnp.where(steps.live[:, None], slopes / jnp.where(steps.live, width, 1.0)[:, None], 1.0).ravel()


@functools.cache
def _bernstein(parts: int) -> Float[np.ndarray, "coefficients 5"]:
    """From the coefficients of a quartic on [0, 1] to the first `HALF` by Bernstein in each of so many equal parts."""
    basis = np.array([[math.comb(i, j) / math.comb(4, j) for j in range(5)] for i in range(HALF)])
    shift = [
        [[math.comb(j, i) * (k / parts) ** (j - i) / parts**i if i <= j else 0.0 for j in range(5)] for i in range(5)]
        for k in range(parts)
    ]
    return np.concatenate([basis @ np.array(one) for one in shift])


def _steps(
    dynamics: PathDynamics,
    phase_schedule: PhaseSchedule,
    duration,
    options: IntegratorOptions,
    at: _PartState,
    length,
    count: int,
):
    """Shares and states along `count` steps that together have a length."""
    row = jnp.zeros((), int)

    def once(state, _):
        phase_time, y = state
        y = solver_step(dynamics, phase_schedule, duration, options, at.segment, row, phase_time, y, length / count)
        phase_time = phase_time + length / count
        return (phase_time, y), (phase_time, y)

    _, (when, place) = jax.lax.scan(once, (at.phase_time, at.y), None, length=count)
    return jnp.concatenate([at.phase_time[None], when]), jnp.concatenate([at.y[None], place])


def _to_break(dynamics, phase_schedule, duration, options, at: _PartState, count: int):
    """`count` steps from where an interval has come to its end or the end of the piece, whichever is first.

    Returns the shares and states of the steps' ends, and whether the piece ended.
    """
    goal = _goal(dynamics, at.segment)
    frozen = stop_gradient((dynamics, phase_schedule, duration))
    still = stop_gradient(at)
    whole = 1 - still.phase_time

    def narrow(bracket):
        """Newton on the part's length, bisecting where it would leave the bracket."""
        low, high, length, _, number = bracket
        _, place = _steps(*frozen, options, still, length, count)
        miss = place[-1, 0] - goal
        low, high = jnp.where(miss < 0, length, low), jnp.where(miss < 0, high, length)
        guess = length - miss / jnp.where(place[-1, 1] == 0, 1.0, place[-1, 1])
        guess = jnp.where((guess >= low) & (guess <= high), guess, (low + high) / 2)
        through = (number == 0) & ~(miss > 0)
        near = jnp.abs(guess - length) <= KINK_TOL * whole
        return low, high, jnp.where(through, whole, guess), through | near, number + 1

    start = (0 * whole, whole, whole, ~(whole > 0), 0)
    _, _, length, settled, _ = jax.lax.while_loop(lambda b: ~b[3] & (b[4] < MAX_KINK_ITERATIONS), narrow, start)
    onward = length < whole
    when, place = _steps(
        dynamics, phase_schedule, duration, options, at, jnp.where(onward, length, 1 - at.phase_time), count
    )

    def rate(phase_time, y):
        row = jnp.zeros((), int)
        return jnp.stack(
            [y[1], path_acceleration(dynamics, phase_schedule, duration, at.segment, row, phase_time, y[0], y[1])]
        )

    # The cut lies where the end is exactly the goal: a shift of rounding size that carries the cut's derivatives.
    pace = jnp.where(onward, stop_gradient(place[-1, 1]), 1.0)
    late = jnp.where(onward, (jnp.where(onward, goal, 0.0) - place[-1, 0]) / pace, 0.0)
    shift = late * jnp.linspace(0.0, 1.0, count + 1)
    place = place + stop_gradient(jax.vmap(rate)(when, place)) * shift[:, None]
    return when + shift, jnp.where(settled, place, jnp.nan), onward
