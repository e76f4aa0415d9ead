"""Look up: a row of an array by a number that is computed, to read or to write it."""

import jax
from jaxtyping import Array, Int


def take_row(values: Array, number: Int[Array, ""]) -> Array:
    """`values[number]` for a number that is within the array: what else `[]` sees to, negative numbers above all, takes
    three operations each time, which is much where it happens in hundreds of places."""
    return jax.lax.dynamic_index_in_dim(values, number, keepdims=False, allow_negative_indices=False)


def set_row(rows, number: Int[Array, ""], row):
    """Arrays with row `number`, which is within them, replaced."""
    return jax.tree.map(lambda a, b: jax.lax.dynamic_update_index_in_dim(a, b, number, 0), rows, row)
