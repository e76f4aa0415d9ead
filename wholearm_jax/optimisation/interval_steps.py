"""Integration of one interval: fixed solver steps to the interval's end, or to the first kink of the path.

An interval is a short phase: its time `u` runs from 0 to 1 and `w = ds/du`. Steps may pass rest and the path's end:
forces continue smoothly there.

Derivation: section 9 of `docs/derivation.md`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float, Int

from wholearm_jax.core import find_bracketed_root
from wholearm_jax.dynamics import PathDynamics
from wholearm_jax.model import PhaseSchedule
from wholearm_jax.simulation import IntegratorOptions, PathODE, solver_step, state_rate

MAX_KINK_ITERATIONS = 30  # most Newton steps to the kink
KINK_TOL = 1e-8  # size of the last Newton step, over the interval; the rest is corrected to first order

Times = Float[Array, "ends"]  # interval times at which steps end, the first one's start included
States = Float[Array, "ends 2"]  # (s, w) at these times


class PartState(NamedTuple):
    """Where the simulation of an interval stands; each part of an interval lies in one path segment."""

    phase_time: Float[Array, "*intervals"]  # interval time; 1: simulated to its end
    y: Float[Array, "*intervals 2"]  # (s, w)
    segment: Int[Array, "*intervals"]
    has_part: Bool[Array, "*intervals"]  # whether a part of the interval has been simulated


def interval_ode(dynamics: PathDynamics, intervals: int, q: Float[Array, "7"]) -> PathODE:
    """Build the equation of motion of an interval from its inputs `q`, for a phase of `intervals`."""
    values, zero = q[2:6].reshape(2, 2) * dynamics.torque_limit, jnp.zeros((), int)
    phase_schedule = PhaseSchedule(jnp.arange(2.0), values, values[1:] - values[:-1], zero, zero)
    return PathODE(dynamics, phase_schedule, jnp.exp(q[6]) / intervals)


def begin_interval(dynamics: PathDynamics, intervals: int, q: Float[Array, "7"]) -> PartState:
    """Return the state in which an interval begins."""
    y = jnp.stack([dynamics.breakpoints[0] + dynamics.length * q[0], dynamics.length / intervals * q[1]])
    exists = jnp.arange(dynamics.breakpoints.shape[0]) < dynamics.count
    segment = jnp.maximum(((stop_gradient(y[0]) >= dynamics.breakpoints) & exists).sum() - 1, 0)
    return PartState(jnp.zeros(()), y, segment, jnp.asarray(False))


def integrate_to_end(
    ode: PathODE, options: IntegratorOptions, start: PartState, count: int
) -> tuple[PartState, Times, States]:
    """Integrate a whole interval in the segment where it begins, in `count` steps.

    Returns the state after it and the ends of the steps. An interval that passes the segment's end stays at `start`.
    """
    times, states = _integrate_steps(ode, options, start, 1.0, count)
    crosses = states[-1, 0] > _segment_end(ode.dynamics, start.segment)
    end = PartState(jnp.ones_like(start.phase_time), states[-1], start.segment, jnp.asarray(True))
    after = jax.tree.map(lambda stay, go: jnp.where(crosses, stay, go), start, end)
    return after, times, states


def integrate_to_kink(
    ode: PathODE, options: IntegratorOptions, start: PartState, count: int
) -> tuple[PartState, Times, States]:
    """Integrate from `start` to the interval's end or the segment's, whichever comes first, in `count` steps.

    Returns the state after it, in the next segment where the segment has ended, and the ends of the steps; states are
    NaN where the length of the steps has not been found.
    """
    remaining = 1 - start.phase_time
    s_kink = _segment_end(ode.dynamics, start.segment)
    length, converged = _length_to_kink(*stop_gradient((ode, start, s_kink)), options, count)
    ends_at_kink = length < stop_gradient(remaining)
    times, states = _integrate_steps(ode, options, start, jnp.where(ends_at_kink, length, remaining), count)

    def rate(phase_time, y):
        return state_rate(ode, start.segment, jnp.zeros((), int), phase_time, y)

    # One more Newton step, of rounding size: it carries the derivatives of the kink's time.
    speed = jnp.where(ends_at_kink, stop_gradient(states[-1, 1]), 1.0)
    late = jnp.where(ends_at_kink, (jnp.where(ends_at_kink, s_kink, 0.0) - states[-1, 0]) / speed, 0.0)
    shift = late * jnp.linspace(0.0, 1.0, count + 1)
    states = states + stop_gradient(jax.vmap(rate)(times, states)) * shift[:, None]
    times, states = times + shift, jnp.where(converged, states, jnp.nan)

    # Speeds change at a kink, where the path's parameter does.
    next_segment = jnp.minimum(start.segment + 1, ode.dynamics.speed_ratio.shape[0] - 1)
    ratio = ode.dynamics.speed_ratio[next_segment]
    after = PartState(
        phase_time=jnp.where(ends_at_kink, times[-1], 1.0),
        y=states[-1] * jnp.where(ends_at_kink, jnp.stack([jnp.ones_like(ratio), ratio]), 1.0),
        segment=start.segment + ends_at_kink,
        has_part=jnp.asarray(True),
    )
    return after, times, states


def _segment_end(dynamics: PathDynamics, segment) -> Float[Array, ""]:
    """Where a segment ends for intervals: the last one never."""
    return jnp.where(segment >= dynamics.count - 1, jnp.inf, dynamics.breakpoints[segment + 1])


def _length_to_kink(
    ode: PathODE, start: PartState, s_kink, options: IntegratorOptions, count: int
) -> tuple[Float[Array, ""], Bool[Array, ""]]:
    """Find the time from `start` after which `count` steps end at `s_kink`; all that remains if they fall short.

    Also returns whether the iteration converged.
    """
    remaining = 1 - start.phase_time

    def overshoot(length):
        _, states = _integrate_steps(ode, options, start, length, count)
        return states[-1, 0] - s_kink, states[-1, 1]

    return find_bracketed_root(
        overshoot,
        remaining,
        tolerance=KINK_TOL * remaining,
        max_iterations=MAX_KINK_ITERATIONS,
        may_lie_beyond=True,
    )


def _integrate_steps(
    ode: PathODE, options: IntegratorOptions, start: PartState, length, count: int
) -> tuple[Times, States]:
    """Take `count` equal solver steps of the given total length."""
    row = jnp.zeros((), int)

    def step(carry, _):
        phase_time, y = carry
        y = solver_step(*ode, options, start.segment, row, phase_time, y, length / count)
        phase_time = phase_time + length / count
        return (phase_time, y), (phase_time, y)

    _, (times, states) = jax.lax.scan(step, (start.phase_time, start.y), None, length=count)
    return jnp.concatenate([start.phase_time[None], times]), jnp.concatenate([start.y[None], states])
