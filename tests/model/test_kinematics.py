"""Closed forms of contacts against automatic derivatives, for all that may meet, in contact and apart."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import layered

from wholearm_jax.model.kinematics import (
    constraint_jacobian,
    constraint_second_derivative,
    constraint_velocity,
    constraints,
    contact_kinematics,
    contact_velocity,
    slip_velocity,
    tangential_jacobian,
)
from wholearm_jax.model.mechanics import scaled_mechanics
from wholearm_jax.model.scene import rigid_body

NEAR = {"rtol": 1e-13, "atol": 1e-13}
scaled = jax.jit(scaled_mechanics)


@pytest.fixture(scope="module", params=["heptagon", "tipping"])
def mechanics(request):
    """A formation that slides, and one with a contact that rolls; its candidates are all groups of features."""
    scene = layered(request.param)
    return scaled(rigid_body(scene.object), scene.hand, scene.gravity, scene.phases[0].formation)


def anywhere(seed):
    """A configuration, of which nothing need touch, and a direction."""
    return jnp.asarray(np.random.default_rng(seed).normal(size=(2, 5)))


@pytest.mark.parametrize("angle", [np.pi, -np.pi, np.nextafter(np.pi, 4), 1e-9, 0.0, np.pi / 2])
def test_a_body_turns_by_its_angle(mechanics, angle):
    """Also where the tangent of half the angle is infinite but for rounding."""
    z = jnp.asarray([0.1, 0.2, angle, angle, angle])
    vertex = np.stack(mechanics.candidates.point)

    def at(z):
        return contact_kinematics(mechanics.candidates, z).from_object

    turned = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]) @ vertex
    on = np.asarray(mechanics.candidates.on_link)
    np.testing.assert_allclose(np.stack(at(z), axis=1)[on], turned.T[on], atol=1e-15)
    slope = np.stack(jax.jacfwd(at)(z), axis=1)[on, :, 2]
    np.testing.assert_allclose(slope, np.stack([-turned[1], turned[0]], axis=1)[on], atol=1e-15)


@pytest.mark.parametrize("seed", [0, 1])
def test_rates_are_derivatives_of_gaps_and_places(mechanics, seed):
    z, x = anywhere(seed)
    for several in (mechanics.contacts, mechanics.candidates):
        at = contact_kinematics(several, z)
        _, (gap, along) = jax.jvp(
            lambda z, s=several: (contact_kinematics(s, z).gap, contact_kinematics(s, z).along), (z,), (x,)
        )
        np.testing.assert_allclose(contact_velocity(several, at, x, 1.0, 0.0), gap, **NEAR)
        np.testing.assert_allclose(contact_velocity(several, at, x, 0.0, 1.0), along, **NEAR)
        np.testing.assert_allclose(contact_velocity(several, at, x, 2.0, -3.0), 2 * gap - 3 * along, **NEAR)


@pytest.mark.parametrize("seed", [2, 3])
def test_what_leaves_out_the_rows_is_their_product(mechanics, seed):
    z, x = anywhere(seed)
    several = mechanics.contacts
    np.testing.assert_allclose(constraint_velocity(several, z, x), constraint_jacobian(several, z) @ x, **NEAR)
    np.testing.assert_allclose(
        slip_velocity(several, z, x), several.slides * (tangential_jacobian(several, z) @ x), **NEAR
    )


@pytest.mark.parametrize("seed", [4, 5])
def test_curvature_of_all_that_may_meet(mechanics, seed):
    z, x = anywhere(seed)
    for several in (mechanics.contacts, mechanics.candidates):

        def slope(z, several=several):
            return jax.jvp(lambda z: constraints(several, z), (z,), (x,))[1]

        _, curvature = jax.jvp(slope, (z,), (x,))
        np.testing.assert_allclose(constraint_second_derivative(several, z, x), curvature, rtol=1e-12, atol=1e-12)
