"""Requirements: what functions need of their arguments and of JAX, said at once and in one line."""

import jax.numpy as jnp


def require_x64() -> None:
    """Raise unless JAX computes in 64 bits: the statuses' tolerances need them."""
    if jnp.result_type(float) != jnp.float64:  # an array would wait for the compiler while programs compile beside
        raise RuntimeError("this function needs float64; call wholearm_jax.configure() before JAX computes anything")


def require_positive(**numbers: float) -> None:
    """Raise ValueError for a number, given by its name, that is not positive."""
    for name, number in numbers.items():
        if not number > 0:
            raise ValueError(f"{name} must be positive, not {number}")
