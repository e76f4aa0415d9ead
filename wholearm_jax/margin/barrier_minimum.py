"""The smooth minimum that is optimised in place of a minimum."""

import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Float

MAX_BARRIER_ITERATIONS = 40


def log_barrier_minimum(
    values: Float[Array, "..."], weights: Float[Array, "..."], mu: Float[Array, ""]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    r"""Compute the smooth minimum `phi = max_m [ m + mu sum_i w_i log((values_i - m) / mu) ]`.

    It is concave in the values, and its gradient `mu w_i / (values_i - m)` sums to one.

    Args:
        values: Values; those of zero weight are left out.
        weights: Weights `w`, not negative.
        mu: Barrier parameter, in the unit of the values.

    Returns:
        `phi`, and the maximiser `m`: it solves `sum_i mu w_i / (values_i - m) = 1` and lies between
        `min - mu sum(w)` and `min`.
    """
    has_weight = stop_gradient(weights) > 0
    values = jnp.where(has_weight, values, 0.0)
    fixed = stop_gradient(values)
    low = jnp.where(has_weight, fixed, jnp.inf).min()
    largest_weight = jnp.where(has_weight & (fixed <= low), weights, 0.0).max()

    def newton_step(state):
        m, _, count = state
        slack = jnp.where(has_weight, fixed - m, 1.0)
        residual = mu * (weights / slack).sum() - 1.0
        step = residual / (mu * (weights / slack**2).sum())
        return m - step, jnp.abs(step), count + 1

    def continues(state):
        m, step_size, count = state
        return (count < MAX_BARRIER_ITERATIONS) & (step_size > 4 * jnp.finfo(m.dtype).eps * (jnp.abs(m) + mu))

    # From below Newton's method converges monotonically.
    begin = stop_gradient(low - mu * largest_weight)
    m, *_ = jax.lax.while_loop(continues, newton_step, (begin, jnp.full_like(begin, jnp.inf), 0))
    m = stop_gradient(m)
    return m + mu * (weights * jnp.log(jnp.where(has_weight, values - m, 1.0) / mu)).sum(), m
