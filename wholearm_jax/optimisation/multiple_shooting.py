"""Direct multiple shooting: simulate each interval between two torque knots from a state that is itself a variable.

An interval's simulation ends in a state that must equal the next variable; the differences, the *defects*, vanish at
the solution, and the intervals together are then the simulation of the phase. Because each interval is short, its end
depends on its start almost linearly, even where the motion as a whole is unstable or starts after a long dwell.

An interval that crosses kinks of the path is cut there into *parts*, each in one path segment. Only a simulation of
the whole phase (`simulate_motion`) decides what happens at rest and at the path's end.

Source of the method: H. G. Bock and K. J. Plitt, A multiple shooting algorithm for direct solution of optimal control
problems, IFAC World Congress 1984.

Derivation: section 9 of `docs/derivation.md`.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from wholearm_jax.core import take_row
from wholearm_jax.dynamics import PathDynamics
from wholearm_jax.optimisation.interval_samples import PartSamples, sample_part, steps_per_interval
from wholearm_jax.optimisation.interval_steps import (
    PartState,
    begin_interval,
    integrate_to_end,
    integrate_to_kink,
    interval_ode,
)
from wholearm_jax.simulation import IntegratorOptions

MAX_REENTRIES = 3  # parts of a phase's intervals beyond one an interval and one a path segment, as by going back


class IntervalResults(NamedTuple):
    """Simulated intervals of a phase.

    Rows `0..n-1` of the parts: the first part of each interval. Rows `n..n+segments-1`: the part that first enters each
    path segment across a kink. Remaining rows: re-entries of a segment.
    """

    parts: PartSamples
    interval_of_part: Int[Array, "parts"]
    end: Float[Array, "intervals 2"]  # state in which each interval ends, as in `Variables`


class _CutState(NamedTuple):
    """Loop state while intervals that cross kinks are simulated part by part."""

    intervals: PartState  # where each interval stands
    parts: PartSamples  # as in `IntervalResults`
    interval_of_part: Int[Array, "parts"]
    entered: Bool[Array, "segments"]  # segments that a part has entered across a kink
    next_row: Int[Array, ""]  # row of the next re-entry


def extra_parts(dynamics: PathDynamics) -> int:
    """Return the number of parts that the intervals of a phase may have together beyond one each."""
    return dynamics.speed_ratio.shape[-1] + MAX_REENTRIES


def simulate_intervals(
    dynamics: PathDynamics, options: IntegratorOptions, intervals: int, q: Float[Array, "n 7"]
) -> IntervalResults:
    """Simulate `n` intervals of a phase that has `intervals` as a whole.

    Args:
        dynamics: the phase's path dynamics.
        options: solver of the steps; their number is fixed.
        intervals: the number of intervals of the whole phase: an interval lasts that fraction of the duration.
        q: inputs of each interval (`interval_inputs`).

    Returns:
        Parts, in which interval each lies, and the intervals' ends. An interval whose end is not reached ends in NaN:
        where intervals are cut more often than `extra_parts` allows, or a kink is not found.
    """
    n, capacity = q.shape[0], q.shape[0] + extra_parts(dynamics)
    segments = dynamics.speed_ratio.shape[-1]

    # Simulate all intervals whole, side by side; those that cross a kink do not start.
    begin = jax.vmap(lambda q: begin_interval(dynamics, intervals, q))(q)
    first, samples = jax.vmap(partial(_simulate_part, integrate_to_end, dynamics, options, intervals))(begin, q)
    parts = jax.tree.map(lambda a: jnp.zeros((capacity, *a.shape[1:]), a.dtype).at[:n].set(a), samples)
    owner = jnp.minimum(jnp.arange(capacity), n - 1)

    def unfinished(loop: _CutState):
        return jnp.any(loop.intervals.phase_time < 1) & (loop.next_row < capacity)

    def simulate_next_part(loop: _CutState) -> _CutState:
        k = jnp.argmax(loop.intervals.phase_time < 1)
        start = jax.tree.map(lambda a: take_row(a, k), loop.intervals)
        after, samples = _simulate_part(integrate_to_kink, dynamics, options, intervals, start, take_row(q, k))
        return _record_part(loop, k, n, start, after, samples)

    # Simulate the few that do one part at a time.
    start = _CutState(first, parts, owner, jnp.zeros(segments, bool), jnp.asarray(n + segments))
    loop = jax.lax.while_loop(unfinished, simulate_next_part, start)

    # Scale the ends as variables are.
    y = jnp.where((loop.intervals.phase_time < 1)[:, None], jnp.nan, loop.intervals.y)
    end = jnp.stack([y[:, 0] - dynamics.breakpoints[0], y[:, 1] * intervals], axis=1) / dynamics.length
    return IntervalResults(loop.parts, loop.interval_of_part, end)


def _simulate_part(
    integrate, dynamics: PathDynamics, options: IntegratorOptions, intervals: int, start: PartState, q
) -> tuple[PartState, PartSamples]:
    """Integrate a part of an interval, `integrate_to_end` or `integrate_to_kink`, and sample it."""
    ode = interval_ode(dynamics, intervals, q)
    after, times, states = integrate(ode, options, start, steps_per_interval(intervals))
    return after, sample_part(ode, intervals, times, states, start.segment)


def _record_part(loop: _CutState, k, n: int, start: PartState, after: PartState, samples: PartSamples) -> _CutState:
    """Write a part of interval `k` to its row: the interval's own, that of the segment, or that of a re-entry."""
    entered = take_row(loop.entered, start.segment)
    row = jnp.where(start.has_part, jnp.where(entered, loop.next_row, n + start.segment), k)
    return _CutState(
        intervals=jax.tree.map(lambda a, new: a.at[k].set(new), loop.intervals, after),
        parts=jax.tree.map(lambda a, new: a.at[row].set(new), loop.parts, samples),
        interval_of_part=loop.interval_of_part.at[row].set(k),
        entered=loop.entered.at[start.segment].set(entered | start.has_part),
        next_row=loop.next_row + (start.has_part & entered),
    )
