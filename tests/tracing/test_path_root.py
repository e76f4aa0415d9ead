"""Newton's method along a path, against a general method on the same equations, and its differences."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import root
from support import layered

import wholearm_jax as wa
from wholearm_jax.model.kinematics import constraint_jacobian, constraints, tangential_jacobian
from wholearm_jax.model.mechanics import scaled_mechanics
from wholearm_jax.model.scene import rigid_body
from wholearm_jax.tracing.path_root import path_derivatives, solve_on_path


@pytest.fixture(scope="module")
def flip():
    """The heptagon's second phase: its system, a place on its path, the tangent there, and where the third contact's
    slip turns round."""
    scene = layered("heptagon")
    phase, path = scene.phases[1], wa.trace(scene)[1].path
    mechanics = scaled_mechanics(rigid_body(scene.object), scene.hand, scene.gravity, phase.formation)
    near = path.nodes[int(path.first[1]) - 2, 0]
    return (
        mechanics,
        near,
        path_derivatives(mechanics, near, path.chart[0]).x,
        int(jnp.argmin(slip_at(mechanics, path))),
    )


def slip_at(mechanics, path):
    """How little each contact slips where the first piece ends."""
    place = path.nodes[int(path.first[1])].mean(0)
    return jnp.abs(tangential_jacobian(mechanics.contacts, place) @ path_derivatives(mechanics, place, path.chart[0]).x)


def turns(mechanics, z, x, contact):
    """The slip of a contact."""
    return tangential_jacobian(mechanics.contacts, z)[contact] @ x


def known(mechanics, guess, contact):
    """The same place by MINPACK, from rows alone: its tangent is a null vector of NumPy's."""

    def equations(z):
        rows = np.asarray(constraint_jacobian(mechanics.contacts, z))
        null = np.linalg.svd(rows)[2][-1]
        null = null / (null @ np.linalg.svd(rows0)[2][-1])
        slip = np.asarray(tangential_jacobian(mechanics.contacts, jnp.asarray(z)))[contact] @ null
        return np.append(constraints(mechanics.contacts, z), slip)

    rows0 = np.asarray(constraint_jacobian(mechanics.contacts, guess))
    found = root(equations, guess, tol=1e-14)
    assert np.abs(found.fun).max() < 1e-12
    return found.x


def test_a_place_is_the_one_that_a_general_method_finds(flip):
    mechanics, near, u, contact = flip
    found = solve_on_path(turns, mechanics, near, u, contact)
    np.testing.assert_allclose(found.z, known(mechanics, np.asarray(near), contact), atol=1e-11)
    np.testing.assert_allclose(constraint_jacobian(mechanics.contacts, found.z) @ found.x, 0.0, atol=1e-14)
    assert float(u @ found.x) == pytest.approx(1.0, abs=1e-14)
    assert float(found.residual) < 1e-8


def test_the_digits_double_with_every_second_step(flip):
    """From off the path, where neither the constraints hold nor the slip vanishes."""
    mechanics, near, u, contact = flip
    far = near + 0.02 * jnp.asarray([1.0, -1.0, 1.0, 1.0, -1.0])
    exact = solve_on_path(turns, mechanics, near, u, contact).z
    errors = [
        float(jnp.abs(solve_on_path(turns, mechanics, far, u, contact, steps=k).z - exact).max()) for k in range(1, 6)
    ]
    for before, after in zip(errors, errors[2:], strict=False):
        assert after < before**2 + 1e-14
    assert errors[0] > 1e-4
    assert errors[-1] < 1e-14


def test_of_two_places_close_together_the_nearer_is_found(flip):
    """From beside the path, where what vanishes there says little of how far along it is."""
    mechanics, near, u, contact = flip
    place = solve_on_path(turns, mechanics, near, u, contact).z

    def both(mechanics, z, x):
        s = u @ (z - place)
        return s * (s - 4e-4) + constraints(mechanics.contacts, z)[0]

    across = constraint_jacobian(mechanics.contacts, place)[0]
    found = solve_on_path(both, mechanics, place + 5e-7 * across / (across @ across), u)
    assert float(u @ (found.z - place)) == pytest.approx(0.0, abs=1e-9)
    assert float(found.residual) < 1e-12


@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_derivatives_of_places_and_tangents(flip, mode):
    """With respect to the object's corners, against differences of the general method's roots."""
    mechanics, near, u, contact = flip
    way = np.random.default_rng(0).normal(size=(4, 2)).T

    def moved(amount):
        point = tuple(p + amount * w for p, w in zip(mechanics.contacts.point, way, strict=True))
        return eqx.tree_at(lambda m: m.contacts.point, mechanics, point)

    def place(amount):
        found = solve_on_path(turns, moved(amount), near, u, contact)
        return jnp.stack([found.z, found.x])

    step = 1e-4

    def exactly(amount):
        z = known(moved(amount), np.asarray(near), contact)
        return np.stack([z, path_derivatives(moved(amount), jnp.asarray(z), u).x])

    one, two = ((exactly(k * step) - exactly(-k * step)) / (2 * k * step) for k in (1, 2))
    np.testing.assert_allclose(mode(place)(0.0), (4 * one - two) / 3, rtol=1e-7, atol=1e-8)


def test_what_is_not_there_is_not_found(flip):
    """Nothing to be seen but a large residual, and finite numbers, derivatives included."""
    mechanics, near, u, _ = flip

    def nowhere(mechanics, z, x, level):
        return level + (z[2] - near[2]) ** 2

    found = solve_on_path(nowhere, mechanics, near, u, 1.0)
    assert float(found.residual) > 0.5
    slope = jax.jacfwd(lambda level: solve_on_path(nowhere, mechanics, near, u, level).z)(1.0)
    assert bool(jnp.isfinite(found.z).all() & jnp.isfinite(found.x).all() & jnp.isfinite(slope).all())
    singular = solve_on_path(turns, mechanics, near, jnp.zeros(5), 0)
    assert bool(jnp.isfinite(singular.z).all() & jnp.isfinite(singular.x).all())
