"""Polynomials with the lowest power first: value, derivative, and fit through values at Chebyshev nodes."""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
from jax.lax import stop_gradient
from jaxtyping import Array, Float

from wholearm_jax.core import eps_power
from wholearm_jax.tracing import chebyshev_points


def evaluate_polynomial(coefficients: Float[Array, "powers ..."], xi: Float[Array, ""]) -> Float[Array, "..."]:
    """Evaluate a polynomial by Estrin's scheme."""
    while (count := coefficients.shape[0]) > 1:
        even, odd = coefficients[0::2], coefficients[1::2]
        product = xi * odd
        even = even + product if count % 2 == 0 else jnp.concatenate([even[:-1] + product, even[-1:]])
        coefficients, xi = even, xi * xi
    return coefficients[0]


def differentiate_polynomial(coefficients: Float[Array, "powers ..."]) -> Float[Array, "powers_1 ..."]:
    """Return the coefficients of a polynomial's derivative."""
    power = jnp.arange(1.0, coefficients.shape[0], dtype=coefficients.dtype)
    return coefficients[1:] * power.reshape(-1, *(1,) * (coefficients.ndim - 1))


@jax.custom_jvp
def evaluate_polynomial_dot(
    coefficients: Float[Array, "powers *rows terms"], xi: Float[Array, ""], terms: Float[Array, "terms"]
) -> Float[Array, "*rows"]:
    """Evaluate a polynomial times `terms`; its derivative in `xi` is contracted with `terms` before it is multiplied
    by the tangents, of which there may be many."""
    return evaluate_polynomial(coefficients, xi) @ terms


def _evaluate_polynomial_dot_jvp(primals, tangents):
    coefficients, xi, terms = primals
    zero = jax.custom_derivatives.SymbolicZero
    coefficients_dot, xi_dot, terms_dot = (None if isinstance(tangent, zero) else tangent for tangent in tangents)
    values = evaluate_polynomial(coefficients, xi)
    total = jnp.zeros(values.shape[:-1], values.dtype)
    if terms_dot is not None:
        total = values @ terms_dot
    if xi_dot is not None:
        total = total + evaluate_polynomial(differentiate_polynomial(coefficients), xi) @ terms * xi_dot
    if coefficients_dot is not None:
        total = total + evaluate_polynomial(coefficients_dot, xi) @ terms
    return values @ terms, total


evaluate_polynomial_dot.defjvp(_evaluate_polynomial_dot_jvp, symbolic_zeros=True)


def fit_panels(functions: dict[str, Float[Array, "panels nodes *shape"]]) -> tuple[dict[str, Array], Float[Array, ""]]:
    """Fit a polynomial on each panel to functions given at its Chebyshev nodes.

    Returns:
        The coefficients of each function (panels, powers, *shape), and the largest error (`_interpolation_error`).
    """
    columns = jnp.concatenate([f.reshape(*f.shape[:2], -1) for f in functions.values()], axis=2)
    to_powers, to_last_four = _chebyshev_transforms(columns.shape[1])
    ends = np.cumsum([math.prod(f.shape[2:]) for f in functions.values()])[:-1]
    # A product that is left to a library keeps a loop over phases in pieces: whole, it takes twice as long to compile.
    powers, last_fours = (
        jnp.split(jnp.asarray(matrix) @ values, ends, axis=2)
        for matrix, values in ((to_powers, columns), (to_last_four, stop_gradient(columns)))
    )
    fitted = {name: each.reshape(f.shape) for (name, f), each in zip(functions.items(), powers, strict=True)}
    errors = [
        _interpolation_error(f.reshape(*f.shape[:2], -1), last_four)
        for f, last_four in zip(functions.values(), last_fours, strict=True)
    ]
    return fitted, jnp.stack(errors).max()


def _interpolation_error(
    values: Float[Array, "panels nodes functions"], last_four: Float[Array, "panels four functions"]
) -> Float[Array, ""]:
    """Estimate the largest error of interpolation, relative to each function's largest value.

    The estimate extrapolates the last four Chebyshev coefficients of each panel: if pairs of coefficients shrink by a
    factor `r`, all that are left out sum to `r / (1 - r)` times the last pair, and the error is at most twice that.
    Where they hardly shrink, as at the level of rounding, the last pair itself is the estimate. Functions far smaller
    than their largest companion (`eps^(1/3)` times: 6e-6 in float64, 5e-3 in float32) may be zero but for rounding and
    are judged against that size.
    """
    earlier, last = jnp.abs(last_four[:, :2]).sum(1), jnp.abs(last_four[:, 2:]).sum(1)
    ratio = jnp.where(3 * last < earlier, 2 * last / jnp.where(last < earlier, earlier - last, 1.0), 1.0)
    size = jnp.abs(stop_gradient(values)).max((0, 1))
    min_size = eps_power(values, 1 / 3) * size.max() + jnp.finfo(values.dtype).tiny
    return ((last * ratio).max(0) / jnp.maximum(size, min_size)).max()


@functools.cache
def _chebyshev_transforms(nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the matrices from values at Chebyshev nodes to power coefficients (nodes, nodes), and to the last four
    Chebyshev coefficients (4, nodes)."""
    x = chebyshev_points(nodes)
    to_chebyshev = np.linalg.inv(np.polynomial.chebyshev.chebvander(x, nodes - 1))
    series = [np.polynomial.chebyshev.cheb2poly(np.eye(nodes)[k]) for k in range(nodes)]
    to_powers = np.stack([np.pad(p, (0, nodes - len(p))) for p in series], axis=1) @ to_chebyshev
    return to_powers, to_chebyshev[-4:]
