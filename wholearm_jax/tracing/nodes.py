"""Nodes of a path: the constraints solved at the Chebyshev nodes of every panel.

Derivation: section 3 of `docs/derivation.md`.
"""

import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Float

from wholearm_jax.core import eps_power, fused_matmul
from wholearm_jax.model import ScaledMechanics, constraint_jacobian, constraints
from wholearm_jax.tracing.curve import TracedCurve, reversal_functions
from wholearm_jax.tracing.path import PathSegments, Resolution, chebyshev_points
from wholearm_jax.tracing.path_root import newton_corrector
from wholearm_jax.tracing.segments import PanelLayout


def solve_nodes(
    mechanics: ScaledMechanics,
    curve: TracedCurve,
    segments: PathSegments,
    layout: PanelLayout,
    resolution: Resolution,
) -> tuple[Float[Array, "panels nodes 5"], Float[Array, "panels nodes"], Float[Array, "panels nodes 6"]]:
    """Solve the constraints at every Chebyshev node.

    Returns:
        The configurations, the sizes of the last Newton steps, and the `reversal_functions`.
    """
    fixed, owner = stop_gradient(mechanics), layout.segment_of_panel
    # Place the nodes, and guess their configurations from the continuation's.
    fraction = (chebyshev_points(resolution.nodes) + 1) / 2
    local = (jnp.arange(resolution.panels) - layout.first[owner])[:, None] + fraction
    low, high = segments.breakpoints[owner][:, None], segments.breakpoints[owner + 1][:, None]
    s = low + (high - low) * local / layout.panels[owner][:, None]
    guess = _hermite_interpolant(curve, stop_gradient(s), segments.chart[owner])

    def solve_node(s, guess, u, anchor, anchor_s):
        # Iterate on constants, then take one differentiable step.
        height = u @ anchor + s - anchor_s
        z, correction, inverse, _ = newton_corrector(fixed, u, guess, stop_gradient(height), 2, eps_power(guess, 3 / 8))
        fixed_z = stop_gradient(z)
        residual = jnp.concatenate([constraints(mechanics.contacts, fixed_z), (u @ fixed_z - height)[None]])
        solution = z - fused_matmul(stop_gradient(inverse), residual)
        here = stop_gradient(solution)
        return solution, correction, reversal_functions(fixed, here, _refined_tangent(fixed, here, u, inverse))

    per_panel = jax.vmap(solve_node, (0, 0, None, None, None))
    return jax.vmap(per_panel)(s, guess, segments.chart[owner], segments.anchor[owner], segments.anchor_s[owner])


def _refined_tangent(mechanics, z, u, inverse):
    """Compute `dz/ds` in the chart `u` by one step of refinement from the inverse of `[G; u]` at a place nearby."""
    x = inverse[:, 4]
    rows = jnp.concatenate([constraint_jacobian(mechanics.contacts, z), u[None]])
    return x + fused_matmul(inverse, jnp.zeros(5, z.dtype).at[4].set(1.0) - fused_matmul(rows, x))


def _hermite_interpolant(curve: TracedCurve, s, u):
    """Interpolate `z` at every `s` by cubic Hermite polynomials between the continuation's nodes."""
    nodes = curve.nodes
    right = jnp.clip((nodes.s < s[..., None]).sum(-1), 1, jnp.maximum(curve.n - 1, 1))
    left = right - 1
    width = nodes.s[right] - nodes.s[left]
    width = jnp.where(jnp.isfinite(width) & (width > 0), width, 1.0)[..., None]
    t = ((s - nodes.s[left])[..., None]) / width
    slope = [nodes.x[k] / jnp.einsum("pni,pi->pn", nodes.x[k], u)[..., None] * width for k in (left, right)]
    low, high = nodes.z[left], nodes.z[right]
    return (
        low * (1 + 2 * t) * (1 - t) ** 2
        + high * t**2 * (3 - 2 * t)
        + slope[0] * t * (1 - t) ** 2
        + slope[1] * t**2 * (t - 1)
    )
