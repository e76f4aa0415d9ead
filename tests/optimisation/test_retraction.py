"""The curve along which a step is taken."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import layered

from wholearm_jax.optimisation.constraints import Limits
from wholearm_jax.optimisation.retraction import retract
from wholearm_jax.optimisation.variables import Variables
from wholearm_jax.phases import trace


@pytest.fixture(scope="module")
def flip():
    return trace(layered("heptagon"))[1].dynamics


def test_a_curved_step_starts_along_its_direction_and_keeps_fixed_torques(flip):
    rng = np.random.default_rng(3)
    state = np.stack([np.linspace(0.1, 0.8, 6), np.full(6, 1.0)], axis=1)
    p = Variables(jnp.asarray(rng.uniform(-0.5, 0.5, (1, 6, 2))), jnp.asarray(state)[None], jnp.zeros(1))
    phase_dynamics = jax.tree.map(lambda a: a[None], flip)
    direction = jax.tree.map(lambda a: jnp.asarray(rng.normal(size=a.shape)), p)
    fixed = np.zeros((1, 6), bool)
    fixed[0, 0] = True
    one, no_rows = jnp.ones(()), jnp.zeros((1, 5, 0, 5))
    limits = Limits(jnp.full(2, jnp.inf), one[None], one[None], 0 * one, jnp.asarray(fixed), jnp.ones(1), no_rows)
    _, tangent = jax.jvp(lambda fraction: retract(p, direction, fraction, phase_dynamics, limits), (0.0,), (1.0,))
    for got, want in zip(jax.tree.leaves(tangent), jax.tree.leaves(direction), strict=True):
        np.testing.assert_allclose(got, want, rtol=1e-9)
    there = retract(p, direction, 0.05, phase_dynamics, limits)
    np.testing.assert_allclose(there.torque[0, 0], p.torque[0, 0] + 0.05 * direction.torque[0, 0], rtol=1e-12)
    assert float(jnp.abs(there.torque[0, 1:] - p.torque[0, 1:] - 0.05 * direction.torque[0, 1:]).max()) > 1e-4
