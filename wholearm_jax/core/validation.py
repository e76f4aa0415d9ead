"""Requirements of public functions on their arguments and on JAX, checked before anything is computed."""

import jax
import jax.numpy as jnp


def require_x64(*trees) -> None:
    """Raise RuntimeError unless JAX computes in float64, which the tolerances of statuses need, and all arrays have it.

    A scene that was loaded before float64 was enabled is in float32, and stays so.
    """
    if any(getattr(leaf, "dtype", None) == jnp.float32 for leaf in jax.tree.leaves(trees)):
        raise RuntimeError(
            "this function needs float64, not float32 arrays; call wholearm_jax.configure() before any other"
        )
    if jnp.result_type(float) != jnp.float64:  # asking an array would wait for programs that compile in the background
        raise RuntimeError("this function needs float64; call wholearm_jax.configure() before JAX computes anything")


def require_positive(**numbers: float) -> None:
    """Raise ValueError for a number, given by its name, that is not positive."""
    for name, number in numbers.items():
        if not number > 0:
            raise ValueError(f"{name} must be positive, not {number}")
