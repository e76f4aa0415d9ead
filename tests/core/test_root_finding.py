"""Newton's method within a bracket: it converges, bisects where it must, and says where there is no root."""

import jax
import jax.numpy as jnp
import pytest

from wholearm_jax.core import find_bracketed_root


def cubic(root):
    """A function whose Newton steps leave the bracket from its flat part."""
    return lambda x: ((x - root) ** 3 + 0.01 * (x - root), 3 * (x - root) ** 2 + 0.01)


def kinked(root):
    """Steep below the root, flat above it."""
    return lambda x: (jnp.where(x < root, 50.0, 0.02) * (x - root), jnp.where(x < root, 50.0, 0.02))


def without_slope(root):
    """A derivative of zero says nothing: steps are as long as the value."""
    return lambda x: (1e3 * (x - root), jnp.zeros_like(x))


def undefined_above(root):
    """Not a number where the argument is too large."""
    return lambda x: (jnp.where(x > 1.5 * root, jnp.nan, x - root), jnp.ones_like(x))


@pytest.mark.parametrize("function", [cubic, kinked, without_slope, undefined_above])
@pytest.mark.parametrize("may_lie_beyond", [False, True])
@pytest.mark.parametrize("root", [1e-3, 0.3, 1.9])
def test_it_finds_a_root_within_the_bracket(function, may_lie_beyond, root):
    if function is undefined_above and may_lie_beyond and root < 1.0:
        pytest.skip("a value that is not a number at the upper end counts as no root")
    x, converged = find_bracketed_root(
        function(root), jnp.asarray(2.0), tolerance=jnp.asarray(1e-12), max_iterations=60, may_lie_beyond=may_lie_beyond
    )
    assert bool(converged)
    assert float(x) == pytest.approx(root, abs=1e-11)


def test_a_root_beyond_the_bracket_gives_its_upper_end():
    x, converged = find_bracketed_root(
        cubic(3.0), jnp.asarray(2.0), tolerance=jnp.asarray(1e-12), max_iterations=60, may_lie_beyond=True
    )
    assert (float(x), bool(converged)) == (2.0, True)


def test_an_empty_bracket_costs_no_iteration():
    def fails(x):
        return jnp.full_like(x, jnp.nan), x

    x, converged = find_bracketed_root(fails, jnp.asarray(0.0), tolerance=jnp.asarray(0.0), max_iterations=60)
    assert (float(x), bool(converged)) == (0.0, True)


def test_too_few_iterations_are_not_convergence():
    _, converged = find_bracketed_root(
        without_slope(0.3), jnp.asarray(2.0), tolerance=jnp.asarray(1e-12), max_iterations=5
    )
    assert not bool(converged)


def test_each_member_of_a_batch_finds_its_own_root():
    roots = jnp.array([0.1, 0.5, 1.7])
    find = jax.vmap(
        lambda root: find_bracketed_root(cubic(root), jnp.asarray(2.0), tolerance=jnp.asarray(1e-12), max_iterations=60)
    )
    x, converged = find(roots)
    assert bool(converged.all())
    assert jnp.abs(x - roots).max() < 1e-11
