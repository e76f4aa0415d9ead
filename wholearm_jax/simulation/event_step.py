"""The last step of a smooth stage, taken again with the length that ends exactly on the stage's terminal event.

Derivation: section 6 of `docs/derivation.md`.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float

from wholearm_jax.core import eps_power, find_bracketed_root
from wholearm_jax.simulation.integrator_options import IntegratorOptions
from wholearm_jax.simulation.path_ode import PathODE, join_state, solver_step, state_rate

MAX_EVENT_ITERATIONS = 40


class EventStep(NamedTuple):
    """The end of a step on an event."""

    phase_time: Float[Array, ""]
    s: Float[Array, ""]
    w: Float[Array, ""]
    at_stop: Bool[Array, ""]  # on `s_stop`; else at rest
    failed: Bool[Array, ""]  # no event lies within the step's length of where it ends
    memory: Float[Array, "memory"] | None  # of a closed-loop law


def step_to_event(
    ode: PathODE, options: IntegratorOptions, segment, row, start, end, s_stop, w_stop, is_needed: Bool[Array, ""]
) -> EventStep:
    """Take a step from `start` that ends at `s = s_stop` or at rest, whichever comes first.

    The length is found without derivatives. A first-order correction of rounding size then carries them: exact in first
    derivatives, as the event's time depends on the step by the implicit function theorem.

    Args:
        ode: Equation of motion.
        options: Options of the integrator.
        segment: Segment of the path.
        row: Interval of the schedule.
        start: Phase time, `s`, `w` and the memory of a law (None: open loop) where the step begins.
        end: Phase time before which the event lies.
        s_stop: Where the segment ends (infinite: nowhere).
        w_stop: Speed at which the object rests: 0 (minus infinity: never).
        is_needed: Whether there is an event; else the step has no length.
    """
    phase_time, s, w, memory = start
    y, max_length = join_state(s, w, memory), jnp.where(is_needed, end - phase_time, 0.0)
    length = _length_to_event(*stop_gradient((ode, phase_time, y, max_length, s_stop)), w_stop, options, segment, row)
    y = solver_step(*ode, options, segment, row, phase_time, y, length)
    rate = stop_gradient(state_rate(ode, segment, row, phase_time + length, y))
    # Choose the event that is nearer in time: an object that comes to rest just at the stop meets both.
    targets = jnp.stack([jnp.where(jnp.isfinite(s_stop), s_stop, 0.0), jnp.zeros_like(s_stop)])
    delays = (targets - y[:2]) / jnp.where(is_needed & (rate[:2] != 0), rate[:2], 1.0)
    is_possible = jnp.stack([jnp.isfinite(s_stop) & (rate[0] > 0), jnp.isfinite(w_stop) & (rate[1] < 0)])
    event = jnp.argmin(jnp.where(is_possible, jnp.abs(stop_gradient(delays)), jnp.inf))
    at_stop = is_needed & (event == 0)
    # Correct time and state to first order.
    delay = jnp.where(is_needed, delays[event], 0.0)
    failed = is_needed & ~(jnp.abs(delay) <= max_length)
    delay = jnp.where(failed, 0.0, delay)
    y = y + rate * delay
    return EventStep(
        phase_time=phase_time + length + delay,
        s=jnp.where(at_stop, targets[0], y[0]),
        w=jnp.where(at_stop, y[1], 0.0),
        at_stop=at_stop,
        failed=failed,
        memory=None if memory is None else y[2:],
    )


def _length_to_event(
    ode: PathODE, phase_time, y, max_length, s_stop, w_stop, options: IntegratorOptions, segment, row
) -> Float[Array, ""]:
    """Find the length of a step that ends on an event, to more than half of the digits: the correction after it brings
    the others."""

    def overshoot(length):
        """How far a step goes past either event, and the rate at which that grows."""
        y_end = solver_step(*ode, options, segment, row, phase_time, y, length)
        past_stop, below_rest = y_end[0] - s_stop, w_stop - y_end[1]
        rate = state_rate(ode, segment, row, phase_time + length, y_end)
        return jnp.maximum(past_stop, below_rest), jnp.where(past_stop >= below_rest, rate[0], -rate[1])

    tolerance = eps_power(max_length, 5 / 8) * max_length
    length, _ = find_bracketed_root(overshoot, max_length, tolerance=tolerance, max_iterations=MAX_EVENT_ITERATIONS)
    return length
