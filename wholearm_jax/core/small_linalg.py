r"""Inverses, determinants and products of small matrices.

Gauss-Jordan elimination with row pivoting, as plain array operations, which a batch runs side by side. LAPACK's batched
routines, as JAX calls them on processors, wait inside the pool of threads that they run on: on two processors a program
with two of them may wait for ever (seen with jaxlib 0.10.2).
"""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


@jax.jit
def inverse_and_determinant(matrix: Float[Array, "n n"]) -> tuple[Float[Array, "n n"], Float[Array, ""]]:
    """Return `A^-1` and `det A`; for a singular matrix the inverse is not finite and the determinant 0.

    Derivatives: `d(A^-1) = -A^-1 dA A^-1` and `d(det A) = det A tr(A^-1 dA)`.
    """
    return _gauss_jordan(matrix)


@jax.custom_jvp
def _gauss_jordan(matrix):
    n = matrix.shape[0]
    rows = jnp.arange(n)

    def clear(k, state):
        """Eliminate column `k`: pivot, scale, subtract."""
        wide, determinant = state
        candidates = jnp.where(rows >= k, jnp.abs(wide[:, k]), -1.0)
        p = jnp.argmax(candidates)
        top, pivot = wide[k], wide[p]
        grown = determinant * pivot[k] * jnp.where(p == k, 1.0, -1.0)
        determinant = jnp.where(determinant == 0, 0.0, grown)  # what follows a pivot of 0 is not a number
        pivot = pivot / pivot[k]
        wide = jnp.where((rows == p)[:, None], top, wide)
        wide = jnp.where((rows == k)[:, None], pivot, wide - wide[:, k][:, None] * pivot)
        return wide, determinant

    wide = jnp.concatenate([matrix, jnp.eye(n, dtype=matrix.dtype)], axis=1)
    wide, determinant = jax.lax.fori_loop(0, n, clear, (wide, jnp.ones((), matrix.dtype)))
    return wide[:, n:], determinant


@_gauss_jordan.defjvp
def _gauss_jordan_jvp(primals, tangents):
    (matrix,), (rate,) = primals, tangents
    inverted, determinant = _gauss_jordan(matrix)
    relative = fused_matmul(inverted, rate)
    return (inverted, determinant), (-fused_matmul(relative, inverted), determinant * jnp.trace(relative))


def null_vector(rows: Float[Array, "4 5"]) -> Float[Array, "5"]:
    """Return the generalised cross product of four rows: its dot product with any row is the determinant of all five.

    Each component is a determinant of four columns by Laplace expansion over pairs of rows. There is no division, and
    linearly dependent rows give zero.
    """
    first, second = _PAIRS.T
    upper, lower = (a[first] * b[second] - a[second] * b[first] for a, b in (rows[:2], rows[2:]))
    return (_SIGNS * upper[_UPPER] * lower[_LOWER]).sum(1)


def _laplace() -> tuple[np.ndarray, ...]:
    """Return the pairs of columns and, for each omitted column, the pairs of the minors to multiply, with signs."""
    pairs = list(itertools.combinations(range(5), 2))
    terms = []
    for out in range(5):
        for pair in (p for p in pairs if out not in p):
            third, fourth = (k for k in range(5) if k != out and k not in pair)
            sign = np.linalg.det(np.eye(5)[[*pair, third, fourth, out]])
            terms.append((pairs.index(pair), pairs.index((third, fourth)), np.rint(sign)))
    return np.array(pairs), *(np.array(column).reshape(5, 6) for column in zip(*terms, strict=True))


_PAIRS, _UPPER, _LOWER, _SIGNS = _laplace()


def fused_matmul(matrix: Float[Array, "m n"], right: Float[Array, "n *columns"]) -> Float[Array, "m *columns"]:
    """Multiply a matrix by a vector or a matrix as a sum of products.

    XLA fuses the sum with the operations around it; a call of a matrix library costs more than so small a product.
    """
    if right.ndim == 1:
        return (matrix * right).sum(1)
    return sum((matrix[:, k, None] * right[k] for k in range(1, len(right))), matrix[:, :1] * right[0])


def linear_solve(matrix: Float[Array, "n n"], right: Float[Array, "n *columns"]) -> Float[Array, "n *columns"]:
    """Return `A^-1 b`."""
    return fused_matmul(inverse_and_determinant(matrix)[0], right)
