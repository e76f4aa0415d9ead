"""The minimum of one slack within one step of a motion: its place, its value on the true motion, its derivatives."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Float

from wholearm_jax.core import take_row
from wholearm_jax.margin.contact_forces import contact_force, force_slack, slacks_at
from wholearm_jax.simulation import IntegratorOptions, PathODE, join_state, solver_step, split_state, state_rate

GOLDEN_ITERATIONS = 17  # a Newton step on the true motion follows


def golden_section(function, low: Float[Array, ""], high: Float[Array, ""]) -> Float[Array, ""]:
    """Find about where `function` is least in `[low, high]`; an end of the bracket counts where it is lower."""
    golden = (math.sqrt(5) - 1) / 2

    def narrow(k, state):
        """Evaluate both ends first, then two inner points; each round keeps the part with the lower one."""
        low, high, best, least = state
        width = high - low
        points = jnp.where(k == 0, jnp.stack([low, high]), jnp.stack([high - golden * width, low + golden * width]))
        values = jax.vmap(function)(points)
        lower = jnp.argmin(values)
        is_better = values[lower] < least
        low = jnp.where((k > 0) & (lower == 1), points[0], low)
        high = jnp.where((k > 0) & (lower == 0), points[1], high)
        return low, high, jnp.where(is_better, points[lower], best), jnp.minimum(values[lower], least)

    start = (low, high, low, jnp.full_like(low, jnp.inf))
    return stop_gradient(jax.lax.fori_loop(0, GOLDEN_ITERATIONS, narrow, start)[2])


def refine_minimum(inputs, options: IntegratorOptions, row, xi, low, high):
    """Compute the minimum of a slack near `xi` on the true motion, to second order.

    Value and slope are those at the end of a step of the solver to `xi`, so that they are as accurate as the
    integration; the second derivative is that of the quintic.

    Args:
        inputs: `(dynamics, phase_schedule, duration, step, w_begin)`: all that it can be differentiated by.
        options: Options of the integrator.
        row: Constraint.
        xi: Place in [0, 1] of the step.
        low: Lower limit of the minimum's place.
        high: Upper limit of the minimum's place.

    Returns:
        The minimum [N], and its place `xi`. With the place fixed, its derivative is that at the true minimum.
    """
    # Evaluate the slack and its slope in time where a step of the solver ends at `xi`.
    dynamics, phase_schedule, duration, step, w_begin = inputs
    width = step.phase_time[1] - step.phase_time[0]
    phase_time, begin = step.phase_time[0] + xi * width, _begin_state(step, w_begin)
    end = solver_step(
        dynamics, phase_schedule, duration, options, step.segment, step.row, step.phase_time[0], begin, xi * width
    )

    def slack(phase_time, y):
        at = step.segment, step.row, phase_time, *split_state(y)
        forces = contact_force(dynamics, phase_schedule, duration, *at)
        return take_row(force_slack(dynamics, forces), row)

    rate = state_rate(PathODE(dynamics, phase_schedule, duration), step.segment, step.row, phase_time, end)
    value, slope = jax.jvp(slack, (phase_time, end), (jnp.ones_like(phase_time), rate))
    # Take one Newton step to the minimum.
    safe_width = jnp.where(width > 0, width, 1.0)

    def quintic_slack(xi):
        return take_row(slacks_at(dynamics, phase_schedule, duration, step, xi), row)

    curvature = _second_derivative(quintic_slack, xi) / safe_width**2
    is_inner = (xi > 0) & (xi < 1) & (curvature > 0)
    newton = jnp.where(is_inner, slope / jnp.where(is_inner, curvature, 1.0) / safe_width, 0.0)
    place = jnp.clip(xi - newton, low, high)
    shift = stop_gradient((place - xi) * width)
    minimum = value + slope * shift + stop_gradient(curvature) * shift**2 / 2
    return jnp.where(step.live & ~step.at_rest, minimum, jnp.inf), place


@eqx.filter_custom_jvp
def with_envelope_derivative(inputs, options, row, xi, minimum):
    """Return the minimum that was found at `xi`, with the derivatives of `refine_minimum` (the envelope theorem)."""
    return minimum


@with_envelope_derivative.def_jvp
def _(primals, tangents):
    (inputs, options, row, xi, minimum), (inputs_dot, *_) = primals, tangents
    _, rate = eqx.filter_jvp(
        lambda inputs: refine_minimum(inputs, options, row, xi, 0.0, 1.0)[0], (inputs,), (inputs_dot,)
    )
    return minimum, rate


def _begin_state(step, w_begin):
    return join_state(step.quintic[0], w_begin, None if step.memory is None else step.memory[0])


def _second_derivative(function, x):
    one = jnp.ones_like(x)
    return jax.jvp(lambda x: jax.jvp(function, (x,), (one,))[1], (x,), (one,))[1]
