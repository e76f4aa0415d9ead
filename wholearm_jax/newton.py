"""Newton's method for small square systems, with exact first derivatives of the root.

The iterations run on constants; one further step, taken with the Jacobian frozen at the root, carries the derivatives:
for `F(z, p) = 0` it returns `z - J^-1 F(z, p)`, whose derivative is `-J^-1 dF/dp`, the implicit function theorem.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int


class Root(NamedTuple):
    """A root, the largest remaining residual and the number of steps taken."""

    z: Float[Array, "n"]
    residual: Float[Array, ""]
    steps: Int[Array, ""]


def newton(function: Callable, z: Float[Array, "n"], *, steps: int = 20, longest: float = 0.3) -> Root:
    """Find a root of `function` near `z`, each step no longer than `longest`; stops at rounding level.

    `function` must not carry derivatives (see `differentiable`). A root that was not found shows in `residual`.
    """
    eps = jnp.finfo(z.dtype).eps

    def step(state):
        z, _, count, _ = state
        jacobian = jax.jacfwd(function)(z)
        move = -jnp.linalg.solve(jacobian, function(z))
        move = jnp.where(jnp.isfinite(move), move, 0.0)
        size = jnp.abs(move).max()
        move = move * jnp.minimum(1.0, longest / jnp.maximum(size, longest * eps))
        return z + move, jnp.abs(function(z + move)).max(), count + 1, size

    def going(state):
        _, residual, count, size = state
        return (count < steps) & ((size > 4 * eps) & (residual > 0) | (count < 2))

    start = (z, jnp.asarray(jnp.inf, z.dtype), jnp.asarray(0), jnp.asarray(jnp.inf, z.dtype))
    z, residual, count, _ = jax.lax.while_loop(going, step, start)
    return Root(z, residual, count)


def differentiable(function: Callable, root: Float[Array, "n"], *parameters) -> Float[Array, "n"]:
    """One Newton step from `root` that carries the derivatives of `function(z, *parameters) = 0`."""
    root = jax.lax.stop_gradient(root)
    frozen = jax.lax.stop_gradient(parameters)
    jacobian = jax.jacfwd(lambda z: function(z, *frozen))(root)
    return root - jnp.linalg.solve(jacobian, function(root, *parameters))
