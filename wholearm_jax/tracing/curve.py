"""Nodes and charts of a traced curve, and what is evaluated on it: tangent, reversal functions, path coordinate.

Derivation: section 3 of `docs/derivation.md`.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from wholearm_jax.core import null_vector
from wholearm_jax.model import ScaledMechanics, constraint_jacobian, slip_velocity


class Node(NamedTuple):
    """A node of the curve, in object units.

    Signs are those of `reversal_functions`, then whether the chart has changed.
    """

    z: Float[Array, "*nodes 5"]  # configuration
    x: Float[Array, "*nodes 5"]  # unit tangent
    s: Float[Array, "*nodes"]  # path coordinate; infinite in unused rows
    sign_changed: Bool[Array, "*nodes 7"]  # between the node before and this one
    change_fraction: Float[Array, "*nodes 7"]  # of the step to this node at which the sign changes
    orientation: Float[Array, "*nodes"]  # det [G; x]
    chart: Int[Array, "*nodes"]  # number of the chart that led to this node


class Chart(NamedTuple):
    """A local parameterisation `s = anchor_s + direction . (z - anchor)`."""

    direction: Float[Array, "*charts 5"]  # unit vector u
    anchor: Float[Array, "*charts 5"]  # where the chart begins
    anchor_s: Float[Array, "*charts"]  # s there


class TracedCurve(NamedTuple):
    """The curve that continuation has followed to its end."""

    n: Int[Array, ""]  # number of nodes; the last one lies just beyond the end if that was found
    nodes: Node  # stacked
    charts: Chart  # stacked
    end: Int[Array, ""]  # row of `EventValues` that ends the path, -1 for none
    end_z: Float[Array, "5"]  # estimate of the end
    status: Int[Array, ""]  # a `Status`


def oriented_tangent(
    mechanics: ScaledMechanics, z: Float[Array, "5"], hint: Float[Array, "5"]
) -> tuple[Float[Array, "5"], Float[Array, ""]]:
    """Compute the unit tangent `x` on the side of `hint`, and `det [G; x]`.

    The determinant is the product of the singular values of `G`; it changes sign at a bifurcation.
    """
    null = null_vector(constraint_jacobian(mechanics.contacts, z))
    size = jnp.sqrt((null**2).sum()) * jnp.where(null @ hint < 0, -1.0, 1.0)
    return null / size, size


def reversal_functions(mechanics: ScaledMechanics, z: Float[Array, "5"], x: Float[Array, "5"]) -> Float[Array, "6"]:
    """Evaluate the functions whose sign changes are kinks: the contacts' slips, then the joints' speeds."""
    return jnp.concatenate([slip_velocity(mechanics.contacts, z, x), x[3:]])


def sign_with_deadband(values: Float[Array, "*shape"], tolerance) -> Float[Array, "*shape"]:
    """Return signs, 0 for magnitudes of at most `tolerance`."""
    return jnp.where(jnp.abs(values) > tolerance, jnp.sign(values), 0.0)


def path_coordinate(curve: TracedCurve, chart: int | Int[Array, ""], z: Float[Array, "5"]) -> Float[Array, ""]:
    """Compute `s` of a configuration by one of the curve's charts."""
    charts = curve.charts
    return charts.anchor_s[chart] + charts.direction[chart] @ (z - charts.anchor[chart])
