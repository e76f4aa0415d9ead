"""Precision: what counts as zero, and numbers as arrays of the precision that JAX has."""

import jax
import jax.numpy as jnp
import numpy as np


def digits(values, share: float):
    """What is zero to a share of a precision's digits: 1.6e-10 for five eighths of float64's, 5e-5 of float32's."""
    return jnp.finfo(values.dtype).eps ** share


def array(values, dtype=None) -> jax.Array:
    """`jnp.asarray`, but for what is not yet an array without a program to compile for each shape (20 ms each)."""
    known = isinstance(values, jax.Array)
    return jnp.asarray(values, dtype) if known else jax.device_put(np.asarray(values, dtype))
