"""Arrays: conversion to an array of a given type, rows by a computed index, trees stacked along a leading axis."""

from typing import Any

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int


def eps_power(values: Array, power: float):
    """Return `eps ** power` of the array's dtype, e.g. for 5/8: 1.6e-10 in float64, 5e-5 in float32."""
    return jnp.finfo(values.dtype).eps ** power


def as_device_array(values, dtype=None) -> jax.Array:
    """Return `jnp.asarray(values)`; lists and numbers are moved without compiling a program for each shape."""
    if isinstance(values, jax.Array) or is_traced(values):
        return jnp.asarray(values, dtype)
    return jax.device_put(np.asarray(values, dtype))


def as_concrete_array(values, dtype=None) -> jax.Array:
    """Return `as_device_array(values)`, an array that holds its numbers also where it is made within `jit`.

    Numbers that are being transformed stay so.
    """
    if is_traced(values):
        return as_device_array(values, dtype)
    with jax.ensure_compile_time_eval():
        return as_device_array(values, dtype)


def as_strong_array(values, dtype):
    """Return an array of exactly this dtype, not weakly typed.

    NumPy arrays stay in NumPy: passing one to a compiled program takes a tenth of the time of moving it to a device.
    """
    if is_traced(values):
        return jnp.asarray(values, dtype)
    strong = isinstance(values, jax.Array) and values.dtype == dtype and not values.weak_type
    return values if strong else np.asarray(values, dtype)


def is_traced(*trees) -> bool:
    """Say whether any leaf is a tracer, which stands for numbers in a transformation rather than holding them."""
    return any([isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(trees)])


def array_module(*trees) -> Any:
    """Return `jax.numpy` for trees that are traced, else `numpy`, which compiles no program for each shape."""
    return jnp if is_traced(trees) else np


def take_row(values: Array, index: int | Int[Array, ""]) -> Array:
    """Return `values[index]` for an index known to be in range.

    It skips the handling of negative indices, three operations an access.
    """
    return jax.lax.dynamic_index_in_dim(values, index, keepdims=False, allow_negative_indices=False)


def set_row(rows, index: Int[Array, ""], row):
    """Return a tree of arrays with row `index`, known to be in range, replaced."""
    return jax.tree.map(lambda a, b: jax.lax.dynamic_update_index_in_dim(a, b, index, 0), rows, row)


def stack_trees(trees):
    """Stack trees of one structure along a new leading axis."""
    xp = array_module(*trees)
    return jax.tree.map(lambda *leaves: as_device_array(xp.stack(leaves)), *trees)


def unstack_trees(stacked, count: int) -> tuple:
    """Split a stacked tree into its `count` trees."""
    return tuple(jax.tree.map(lambda leaf, k=k: leaf[k, ...], stacked) for k in range(count))
