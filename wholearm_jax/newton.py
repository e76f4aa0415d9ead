"""Newton's method for small square systems, with exact first derivatives of the root.

The iterations run on constants; one further step, with the last iteration's inverse, carries the derivatives:
for `F(z, p) = 0` it returns `z - J^-1 F(z, p)`, whose derivative is `-J^-1 dF/dp`, the implicit function theorem.
Second derivatives of the root are not carried.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Float, Int

from wholearm_jax.elimination import inverse, times
from wholearm_jax.precision import digits


class Root(NamedTuple):
    """A root, the largest residual at the last iterate but one, and the number of steps taken."""

    z: Float[Array, "n"]
    residual: Float[Array, ""]
    steps: Int[Array, ""]


def newton(function: Callable, z: Float[Array, "n"], *parameters, steps: int = 20, longest: float = 0.3) -> Root:
    """A root of `function(z, *parameters)` near `z`, each step no longer than `longest`, to rounding level.

    A root that was not found shows in `residual`, never as NaN or an exception.
    """
    fixed = stop_gradient(parameters)

    def twice(z):
        value = function(z, *fixed)
        return value, value

    def step(state):
        z, _, _, count, _ = state
        jacobian, value = jax.jacfwd(twice, has_aux=True)(z)
        inverted, _ = inverse(jacobian)
        move = -times(inverted, value)
        move = jnp.where(jnp.isfinite(move), move, 0.0)
        size = jnp.abs(move).max()
        move = move * jnp.minimum(1.0, longest / jnp.maximum(size, longest * jnp.finfo(z.dtype).eps))
        return z + move, inverted, jnp.abs(value).max(), count + 1, size

    def going(state):
        _, _, residual, count, size = state
        return (
            (count < steps) & (size > digits(z, 9 / 16)) & (residual > 0)
        )  # what is left is of the square of the step

    far = jnp.asarray(jnp.inf, z.dtype)
    start = (stop_gradient(z), jnp.eye(z.shape[0], dtype=z.dtype), far, jnp.asarray(0, int), far)
    z, inverted, residual, count, _ = jax.lax.while_loop(going, step, start)
    residual = jnp.where(jnp.isfinite(residual), residual, jnp.inf)
    correction = times(stop_gradient(inverted), function(stop_gradient(z), *parameters))
    return Root(z - jnp.where(jnp.isfinite(correction), correction, 0.0), residual, count)
