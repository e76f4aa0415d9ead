"""Where the variables of the optimisation stand in the flattened vector."""

import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from wholearm_jax.optimisation.variables import (
    Variables,
    interval_end_indices,
    interval_input_indices,
    interval_inputs,
    knot_count,
    variable_count,
)


def test_variables_are_flattened_as_the_indices_say():
    rng = np.random.default_rng(2)
    p = Variables(*(jnp.asarray(rng.normal(size=shape)) for shape in ((2, 4, 2), (2, 4, 2), (2,))))
    flat, _ = ravel_pytree(p)
    assert flat.size == variable_count(2, 4)
    assert knot_count(flat.size, 2) == 4
    q = flat[interval_input_indices(2, 4)]
    np.testing.assert_array_equal(q[1, 2], [*p.state[1, 2], *p.torque[1, 2], *p.torque[1, 3], p.log_duration[1]])
    np.testing.assert_array_equal(flat[interval_end_indices(2, 4)], p.state[:, 1:])
    np.testing.assert_array_equal(q, interval_inputs(p))
