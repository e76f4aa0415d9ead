r"""Shoot: one phase cut at its torque knots, every interval simulated from a state that is a variable itself.

The variables of direct multiple shooting are the torques at the knots and the states `(s, v)` there. An interval's
simulation ends in a state that must equal the next variable; these *defects* vanish at the solution, and the intervals
together are then the simulation of the phase. Because each interval is short, its end depends on its beginning almost
linearly, even where the motion as a whole is unstable or starts after a long dwell, and its derivatives are those with
respect to seven numbers, whatever the number of knots.

An interval is a small phase of its own: time is a share of the interval and `w` the speed in `s` per interval. Where it
crosses from one piece of the wire to the next (`wire`), it is cut exactly there. States may pass rest and the wire's
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

from wholearm_jax.core.lookup import take_row
from wholearm_jax.dynamics.path_dynamics import PathDynamics, differentiate_polynomial
from wholearm_jax.margin.contact_forces import MAX_ROLLING, DenseOutput, quintic_hermite, cone_facets, sampled_slacks
from wholearm_jax.model.schedule import PhaseSchedule
from wholearm_jax.simulation.event_step import path_acceleration, solver_step
from wholearm_jax.simulation.integrator import IntegratorOptions

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


def extra_parts(table: PathDynamics) -> int:
    """Room for the parts behind the first ones of all intervals of a phase together."""
    return table.factor.shape[-1] + SPARE


class Samples(NamedTuple):
    """What was sampled in a part of an interval: forces' slacks [N] (`forces.cone_facets`), the samples' shares of
    the phase (0: none), and speeds (`_speed_lower_bounds`) in wire lengths a duration with their shares."""

    forces: Float[Array, "*parts samples rows"]
    weight: Float[Array, "*parts samples"]
    pace: Float[Array, "*parts paces"]
    pace_weight: Float[Array, "*parts paces"]


class IntervalResults(NamedTuple):
    """Intervals simulated: all their parts, in which interval each lies (`owner`), and the states at the intervals'
    ends as in `Variables`. Part `k` is the first one of interval `k`; behind the intervals' number is one for each
    piece of the wire that an interval comes into, and then those that come into a piece once more."""

    parts: Samples
    owner: Int[Array, "parts"]
    end: Float[Array, "intervals 2"]


def interval_inputs(p: Variables) -> Float[Array, "phases intervals 7"]:
    """What each interval depends on: `s`, `v`, two torques at either end, log of the duration."""
    spread = jnp.broadcast_to(p.log_duration[:, None, None], (*p.torque[:, 1:].shape[:2], 1))
    return jnp.concatenate([p.state[:, :-1], p.torque[:, :-1], p.torque[:, 1:], spread], axis=2)


class _PartState(NamedTuple):
    """An interval on its way: where it has come to, and whether one part is behind it; each lies in one piece."""

    share: Float[Array, "*intervals"]
    y: Float[Array, "*intervals 2"]
    piece: Int[Array, "*intervals"]
    begun: Bool[Array, "*intervals"]


def simulate_intervals(table: PathDynamics, how: IntegratorOptions, intervals: int, q: Float[Array, "cut 7"]) -> IntervalResults:
    """Simulate intervals of a phase, which as a whole has `intervals`.

    Where together they are cut more often than there is room for (`extra_parts`), or a cut is not found, they end in NaN.
    """
    cut, room = q.shape[0], q.shape[0] + extra_parts(table)
    pieces = table.factor.shape[-1]
    begin = jax.vmap(lambda q: _interval_start(table, intervals, q))(q)
    begun, firsts = jax.vmap(partial(_simulate_whole, table, how, intervals))(begin, q)
    parts = jax.tree.map(lambda a: jnp.zeros((room, *a.shape[1:]), a.dtype).at[:cut].set(a), firsts)
    owner = jnp.minimum(jnp.arange(room), cut - 1)

    def going(state):
        at, *_, spare = state
        return jnp.any(at.share < 1) & (spare < room)

    def next_part(state):
        """Most intervals have one part: the others go one part at a time."""
        at, parts, owner, come, spare = state
        k = jnp.argmax(at.share < 1)
        one = jax.tree.map(lambda a: take_row(a, k), at)
        after, samples = _simulate_to_kink(table, how, intervals, one, take_row(q, k))
        again = take_row(come, one.piece)
        row = jnp.where(one.begun, jnp.where(again, spare, cut + one.piece), k)
        at = jax.tree.map(lambda a, new: a.at[k].set(new), at, after)
        parts = jax.tree.map(lambda a, new: a.at[row].set(new), parts, samples)
        come = come.at[one.piece].set(again | one.begun)
        return at, parts, owner.at[row].set(k), come, spare + (one.begun & again)

    start = begun, parts, owner, jnp.zeros(pieces, bool), jnp.asarray(cut + pieces)
    done, parts, owner, *_ = jax.lax.while_loop(going, next_part, start)
    y = jnp.where((done.share < 1)[:, None], jnp.nan, done.y)
    end = jnp.stack([y[:, 0] - table.breaks[0], y[:, 1] * intervals], axis=1) / table.length
    return IntervalResults(parts, owner, end)


def _interval_start(table: PathDynamics, intervals: int, q: Float[Array, "7"]) -> _PartState:
    """Where an interval begins."""
    y = jnp.stack([table.breaks[0] + table.length * q[0], table.length / intervals * q[1]])
    real = jnp.arange(table.breaks.shape[0]) < table.count
    piece = jnp.maximum(((stop_gradient(y[0]) >= table.breaks) & real).sum() - 1, 0)
    return _PartState(jnp.zeros(()), y, piece, jnp.asarray(False))


def _simulate_whole(table: PathDynamics, how: IntegratorOptions, intervals: int, at: _PartState, q: Float[Array, "7"]) -> tuple[_PartState, Samples]:
    """To the interval's end, within the piece that it begins in; one that comes past that piece's end does not set
    out."""
    seen, duration = _schedule(table, intervals, q)
    when, place = _steps(table, seen, duration, how, at, 1.0, steps_of(intervals))
    past = place[-1, 0] > _goal(table, at.piece)
    ended = _PartState(jnp.ones_like(at.share), place[-1], at.piece, jnp.asarray(True))
    after = jax.tree.map(lambda stay, go: jnp.where(past, stay, go), at, ended)
    return after, _sampled(table, seen, duration, intervals, when, place, at.piece)


def _simulate_to_kink(table: PathDynamics, how: IntegratorOptions, intervals: int, at: _PartState, q: Float[Array, "7"]) -> tuple[_PartState, Samples]:
    """To the interval's end, or the end of the piece."""
    seen, duration = _schedule(table, intervals, q)
    when, place, onward = _to_break(table, seen, duration, how, at, steps_of(intervals))
    factor = table.factor[jnp.minimum(at.piece + 1, table.factor.shape[0] - 1)]
    after = _PartState(
        share=jnp.where(onward, when[-1], 1.0),
        y=place[-1] * jnp.where(onward, jnp.stack([jnp.ones_like(factor), factor]), 1.0),
        piece=at.piece + onward,
        begun=jnp.asarray(True),
    )
    return after, _sampled(table, seen, duration, intervals, when, place, at.piece)


def _schedule(table: PathDynamics, intervals: int, q: Float[Array, "7"]) -> tuple[PhaseSchedule, Float[Array, ""]]:
    """An interval's torques, and how long it lasts."""
    values, zero = q[2:6].reshape(2, 2) * table.torque_limit, jnp.zeros((), int)
    return PhaseSchedule(jnp.arange(2.0), values, values[1:] - values[:-1], zero, zero), jnp.exp(q[6]) / intervals


def _goal(table: PathDynamics, piece) -> Float[Array, ""]:
    """Where a piece ends for intervals: the last one nowhere."""
    return jnp.where(piece >= table.count - 1, jnp.inf, table.breaks[piece + 1])


def _sampled(table: PathDynamics, seen: PhaseSchedule, duration, intervals: int, when, place, piece) -> Samples:
    """Forces and speeds of a part."""
    count, samples = steps_of(intervals), samples_of(intervals)
    steps = _arcs(table, seen, duration, when, place, piece)
    forces = sampled_slacks(table, seen, duration, steps, samples // count, cone_facets).reshape(samples, -1)
    span = stop_gradient(when[-1] - when[0]) / intervals
    weight, pace_weight = (jnp.full(each, span / each) for each in (samples, SPEED_COEFFICIENTS))
    forces = jnp.where(span > 0, forces, 0.0)
    return Samples(forces, weight, _speed_lower_bounds(steps) / (table.length / intervals), pace_weight)


def _arcs(table: PathDynamics, seen: PhaseSchedule, duration, when, place, piece) -> DenseOutput:
    """A part's steps."""
    share, s, w = (jnp.stack([a[:-1], a[1:]], axis=1) for a in (when, place[:, 0], place[:, 1]))
    count = share.shape[0]
    pieces, row = jnp.broadcast_to(piece, count), jnp.zeros(count, int)
    live = share[:, 1] > share[:, 0]
    quintic = jax.vmap(quintic_hermite, (None, None, None, 0, 0, 0, 0, 0, 0))(table, seen, duration, share, s, w, pieces, row, live)
    return DenseOutput(share, quintic, pieces, row, jnp.zeros(count, bool), live)


def _speed_lower_bounds(steps: DenseOutput) -> Float[Array, "paces"]:
    """What bounds the speed in each half from below: while all are positive, it is nowhere less than the least.

    They are the coefficients, but the last, of `ds/dxi` by Bernstein's polynomials: the first is the speed where the
    half begins, the last that where the next one does. Speeds at some places alone would let it fall below zero between
    them, where an honest simulation stops.
    """
    width = steps.share[:, 1] - steps.share[:, 0]
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


def _steps(table: PathDynamics, seen: PhaseSchedule, duration, how: IntegratorOptions, at: _PartState, length, count: int):
    """Shares and states along `count` steps that together have a length."""
    row = jnp.zeros((), int)

    def once(state, _):
        share, y = state
        y = solver_step(table, seen, duration, how, at.piece, row, share, y, length / count)
        share = share + length / count
        return (share, y), (share, y)

    _, (when, place) = jax.lax.scan(once, (at.share, at.y), None, length=count)
    return jnp.concatenate([at.share[None], when]), jnp.concatenate([at.y[None], place])


def _to_break(table, seen, duration, how, at: _PartState, count: int):
    """`count` steps from where an interval has come to its end or the end of the piece, whichever is first.

    Returns the shares and states of the steps' ends, and whether the piece ended.
    """
    goal = _goal(table, at.piece)
    frozen = stop_gradient((table, seen, duration))
    still = stop_gradient(at)
    whole = 1 - still.share

    def narrow(bracket):
        """Newton on the part's length, bisecting where it would leave the bracket."""
        low, high, length, _, number = bracket
        _, place = _steps(*frozen, how, still, length, count)
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
    when, place = _steps(table, seen, duration, how, at, jnp.where(onward, length, 1 - at.share), count)

    def rate(share, y):
        row = jnp.zeros((), int)
        return jnp.stack([y[1], path_acceleration(table, seen, duration, at.piece, row, share, y[0], y[1])])

    # The cut lies where the end is exactly the goal: a shift of rounding size that carries the cut's derivatives.
    pace = jnp.where(onward, stop_gradient(place[-1, 1]), 1.0)
    late = jnp.where(onward, (jnp.where(onward, goal, 0.0) - place[-1, 0]) / pace, 0.0)
    shift = late * jnp.linspace(0.0, 1.0, count + 1)
    place = place + stop_gradient(jax.vmap(rate)(when, place)) * shift[:, None]
    return when + shift, jnp.where(settled, place, jnp.nan), onward
