"""Precision: what counts as zero, and numbers as arrays of the precision that JAX has."""

import jax
import jax.core
import jax.numpy as jnp
import numpy as np


def eps_power(values, share: float):
    """What is zero to a share of a precision's digits: 1.6e-10 for five eighths of float64's, 5e-5 of float32's."""
    return jnp.finfo(values.dtype).eps ** share


def as_device_array(values, dtype=None) -> jax.Array:
    """`jnp.asarray`, but for what is not yet an array without a program to compile for each shape (20 ms each)."""
    known = isinstance(values, jax.Array)
    return jnp.asarray(values, dtype) if known else jax.device_put(np.asarray(values, dtype))


def as_strong_array(values, dtype):
    """An array of that type and no weaker one, left with NumPy where it is: a compiled program takes it as it comes,
    in a tenth of the time that moving it to a device takes."""
    if isinstance(values, jax.core.Tracer):
        return jnp.asarray(values, dtype)
    strong = isinstance(values, jax.Array) and values.dtype == dtype and not values.weak_type
    return values if strong else np.asarray(values, dtype)
