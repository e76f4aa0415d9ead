"""Roots of scalar functions."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


def find_bracketed_root(
    function: Callable,
    upper: Float[Array, ""],
    *,
    tolerance: Float[Array, ""],
    max_iterations: int,
    may_lie_beyond: bool = False,
) -> tuple[Float[Array, ""], Bool[Array, ""]]:
    """Find a root in `[0, upper]` by Newton's method, bisecting where an iterate would leave the bracket.

    Not differentiable; one Newton step from its result carries the root's derivatives.

    Args:
        function: Maps x to (value, derivative); the value is negative below the root, and not negative above it.
        upper: Upper end of the bracket.
        tolerance: Size of the last step.
        max_iterations: Limit of iterations.
        may_lie_beyond: Try `upper` first, and return it if the function is not positive there. Else the root is known
            to lie within the bracket, and its middle is first.

    Returns:
        The last iterate, and whether the iteration converged.
    """

    def iterate(state):
        low, high, x, _, iteration = state
        value, derivative = function(x)
        low, high = jnp.where(value < 0, x, low), jnp.where(value < 0, high, x)
        newton = x - value / jnp.where(derivative == 0, 1.0, derivative)
        following = jnp.where((newton >= low) & (newton <= high), newton, (low + high) / 2)
        if may_lie_beyond:
            following = jnp.where((iteration == 0) & ~(value > 0), upper, following)
        return low, high, following, jnp.abs(following - x), iteration + 1

    def continues(state):
        *_, step_size, iteration = state
        return (step_size > tolerance) & (iteration < max_iterations)

    first = upper if may_lie_beyond else upper / 2
    start = (jnp.zeros_like(upper), upper, first, upper, jnp.asarray(0, int))
    _, _, root, step_size, _ = jax.lax.while_loop(continues, iterate, start)
    return root, step_size <= tolerance
