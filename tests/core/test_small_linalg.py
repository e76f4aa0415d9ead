"""Inverses and determinants of small matrices against LAPACK's, their derivatives against differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from wholearm_jax.core.small_linalg import inverse_and_determinant, linear_solve, null_vector


@pytest.mark.parametrize("n", [1, 4, 5])
def test_inverse_and_determinant(n):
    matrices = np.random.default_rng(0).normal(size=(200, n, n))
    matrices[0] = np.eye(n)[::-1]  # nothing but exchanges of rows
    inverted, determinants = jax.vmap(inverse_and_determinant)(matrices)
    condition = np.linalg.cond(matrices)[:, None, None]
    exact = np.linalg.inv(matrices)
    assert np.all(np.abs(inverted - exact) <= 1e-14 * condition * np.abs(exact).max((1, 2), keepdims=True))
    np.testing.assert_allclose(determinants, np.linalg.det(matrices), rtol=1e-11)


def test_rows_of_very_different_sizes():
    rng = np.random.default_rng(1)
    matrix = rng.normal(size=(5, 5)) * 10.0 ** rng.integers(-6, 6, (5, 1))
    right = rng.normal(size=5)
    np.testing.assert_allclose(
        linear_solve(jnp.asarray(matrix), jnp.asarray(right)), np.linalg.solve(matrix, right), rtol=1e-11
    )


def test_derivatives_in_both_modes():
    rng = np.random.default_rng(2)
    matrix, way = rng.normal(size=(2, 5, 5))

    def along(t):
        inverted, determinant = inverse_and_determinant(matrix + t * way)
        return jnp.append(inverted.ravel(), determinant)

    forward, reverse = jax.jacfwd(along)(0.0), jax.jacrev(along)(0.0)
    h = 1e-4
    slopes = [(along(k * h) - along(-k * h)) / (2 * k * h) for k in (1, 2)]
    np.testing.assert_allclose(forward, (4 * slopes[0] - slopes[1]) / 3, rtol=1e-8, atol=1e-8 * np.abs(forward).max())
    np.testing.assert_allclose(forward, reverse, rtol=1e-11, atol=1e-11 * np.abs(forward).max())


def test_a_singular_matrix_shows():
    inverted, determinant = inverse_and_determinant(jnp.zeros((5, 5)).at[0, 0].set(1.0))
    assert determinant == 0
    assert not np.all(np.isfinite(inverted))


def test_what_is_orthogonal_to_four_rows():
    rng = np.random.default_rng(3)
    rows, other = rng.normal(size=(200, 4, 5)), rng.normal(size=(200, 5))
    across = jax.vmap(null_vector)(rows)
    np.testing.assert_allclose(jnp.einsum("nij,nj->ni", rows, across), 0.0, atol=1e-13)
    whole = np.concatenate([rows, other[:, None]], axis=1)
    np.testing.assert_allclose((across * other).sum(1), np.linalg.det(whole), rtol=1e-10, atol=1e-13)


def test_nothing_is_across_rows_that_depend_on_one_another():
    rows = np.random.default_rng(4).normal(size=(4, 5))
    rows[3] = rows[0] - 2 * rows[1] + rows[2]
    np.testing.assert_allclose(null_vector(jnp.asarray(rows)), 0.0, atol=1e-14)
