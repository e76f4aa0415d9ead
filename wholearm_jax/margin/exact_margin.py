"""The compressive margin of a motion, exact in time: the least slack over continuous time and all contacts.

Samples of all steps bracket the candidates, golden section refines them on the dense output, and a step of the solver
that ends there gives the value. Its derivative is that of the slack at the minimum (the envelope theorem), at events
and knots too. Derivation: section 7 of `docs/derivation.md`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Float, Int

from wholearm_jax.core import take_row
from wholearm_jax.dynamics import PathDynamics
from wholearm_jax.margin.contact_forces import SAMPLES_PER_STEP, sampled_slacks, slacks_at
from wholearm_jax.margin.refinement import golden_section, refine_minimum, with_envelope_derivative
from wholearm_jax.simulation import Actuation, DenseOutput, IntegratorOptions, Motion, dense_output, evaluate_dense

MAX_REFINED = 4  # candidates refined: those that parabolas through samples put lowest
SAMPLED_STEPS = 16  # steps sampled together
LOSS_BISECTIONS = 50


class MarginResult(NamedTuple):
    """The margin of a phase, and where a contact is first lost."""

    margin: Float[Array, ""]  # least slack [N]
    phase_time: Float[Array, ""]  # of the least slack
    s: Float[Array, ""]  # of the least slack
    contact: Int[Array, ""]  # its row of the formation
    loss_time: Float[Array, ""]  # phase time at which a contact first pulls or slips; infinite: never
    loss_contact: Int[Array, ""]  # its row of the formation


def minimum_margin(
    dynamics: PathDynamics,
    phase_schedule: Actuation,
    duration: Float[Array, ""],
    motion: Motion,
    options: IntegratorOptions,
) -> MarginResult:
    """Compute the margin of a simulated phase.

    Args:
        dynamics: Tabulated path dynamics.
        phase_schedule: Torque schedule of the phase.
        duration: Duration of the phase [s].
        motion: Simulated motion.
        options: Options of the integrator that simulated it.
    """
    steps = dense_output(dynamics, phase_schedule, duration, motion)
    values = _sample(*stop_gradient((dynamics, phase_schedule, duration, steps)), motion.count)

    def candidate(number):
        """What a candidate depends on, its step and its row."""
        k, row = number // values.shape[2], number % values.shape[2]
        step = jax.tree.map(lambda a: take_row(a, k), steps)
        return (dynamics, phase_schedule, duration, step, take_row(motion.w_begin, k)), k, row

    def refine(number):
        """The minimum of a candidate, and its place."""
        inputs, k, row = stop_gradient(candidate(number))
        lowest, spacing = (
            jnp.argmin(take_row(take_row(values, k).T, row)) / (SAMPLES_PER_STEP - 1),
            1.0 / (SAMPLES_PER_STEP - 1),
        )
        low, high = jnp.maximum(lowest - spacing, 0.0), jnp.minimum(lowest + spacing, 1.0)
        xi = golden_section(lambda xi: take_row(slacks_at(*inputs[:4], xi), row), low, high)
        return refine_minimum(inputs, options, row, xi, low, high)

    # Refine the lowest candidates, and choose the least.
    numbers = _lowest(_candidate_minima(values).ravel(), MAX_REFINED)
    minima, places = stop_gradient(jax.vmap(refine)(numbers))
    best = jnp.argmin(minima)
    inputs, _, row = candidate(take_row(numbers, best))
    xi = take_row(places, best)
    margin = with_envelope_derivative(inputs, options, row, xi, take_row(minima, best))
    phase_time, s, _ = evaluate_dense(inputs[3], xi)
    # Find the first loss of contact; a minimum between samples may be the only sign of it.
    loss_time, loss_row = _first_loss(*stop_gradient((dynamics, phase_schedule, duration, steps)), values)
    is_between = (margin < 0) & ~jnp.isfinite(loss_time)
    loss_time = jnp.where(is_between, stop_gradient(phase_time), loss_time)
    loss_row = jnp.where(is_between, row, loss_row)
    return MarginResult(margin, phase_time, s, row, loss_time, loss_row)


def _sample(dynamics, phase_schedule, duration, steps: DenseOutput, count) -> Float[Array, "steps samples rows"]:
    """Sample the slacks of the first `count` steps, a few steps at a time: there is room for many more."""
    rows = steps.live.shape[0]
    few = min(SAMPLED_STEPS, rows)

    def sample(k, values):
        first = jnp.minimum(k * few, rows - few)
        block = jax.tree.map(lambda a: jax.lax.dynamic_slice_in_dim(a, first, few), steps)
        fresh = sampled_slacks(dynamics, phase_schedule, duration, block)
        return jax.lax.dynamic_update_slice_in_dim(values, fresh, first, 0)

    none = jnp.full((rows, SAMPLES_PER_STEP, dynamics.tangential.shape[0]), jnp.inf, steps.quintic.dtype)
    return jax.lax.fori_loop(0, (count + few - 1) // few, sample, none)


def _candidate_minima(values: Float[Array, "steps samples rows"]) -> Float[Array, "steps rows"]:
    """Estimate each slack's minimum in each step: the least of its samples and of the parabola around it."""
    least, lowest = values.min(1), jnp.clip(jnp.argmin(values, axis=1), 1, values.shape[1] - 2)
    before, here, after = (jnp.take_along_axis(values, (lowest + k)[:, None], axis=1)[:, 0] for k in (-1, 0, 1))
    slope, curvature = (after - before) / 2, before - 2 * here + after
    vertex = jnp.clip(-slope / jnp.where(curvature > 0, curvature, jnp.inf), -1.0, 1.0)
    parabola = here + vertex * (slope + vertex * curvature / 2)
    return jnp.where(jnp.isfinite(least), jnp.minimum(least, parabola), jnp.inf)


def _lowest(values: Float[Array, "n"], count: int) -> Int[Array, "count"]:
    """Return the indices of the lowest values, one after the other: sorting them all takes longer."""

    def take(values, _):
        lowest = jnp.argmin(values)
        return values.at[lowest].set(jnp.inf), lowest

    return jax.lax.scan(take, stop_gradient(values), length=count)[1]


def _first_loss(dynamics, phase_schedule, duration, steps: DenseOutput, values):
    """Find the phase time at which a slack first turns negative, and its row, by bisection before the first negative
    sample."""
    negative = (values < 0).any(2)  # their least would go to a library of XLA's, with threads of its own
    first = jnp.argmax(negative.ravel())
    k, sample = first // SAMPLES_PER_STEP, first % SAMPLES_PER_STEP
    step = jax.tree.map(lambda a: take_row(a, k), steps)
    width = 1.0 / (SAMPLES_PER_STEP - 1)
    high = sample * width

    def halve(_, bracket):
        low, high, row = bracket
        middle = (low + high) / 2
        slacks = slacks_at(dynamics, phase_schedule, duration, step, middle)
        is_lost = slacks.min() < 0
        row = jnp.where(is_lost, jnp.argmin(slacks), row)
        return jnp.where(is_lost, low, middle), jnp.where(is_lost, middle, high), row

    bracket = (jnp.maximum(high - width, 0.0), high, jnp.argmin(values[k, sample]))
    _, xi, row = jax.lax.fori_loop(0, jnp.where(jnp.any(negative), LOSS_BISECTIONS, 0), halve, bracket)
    phase_time = evaluate_dense(step, xi)[0]
    return jnp.where(jnp.any(negative), phase_time, jnp.inf), row
