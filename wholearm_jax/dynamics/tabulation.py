"""Tabulation of the path dynamics: the equations of motion solved at every node, scaled, fitted and judged."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float

from wholearm_jax.core import Status, fused_matmul, inverse_and_determinant, null_vector
from wholearm_jax.dynamics.motion_equations import equations_of_motion
from wholearm_jax.dynamics.path_dynamics import PathDynamics
from wholearm_jax.dynamics.polynomials import fit_panels
from wholearm_jax.model import ScaledMechanics, configuration_unit
from wholearm_jax.tracing import ContactPath, PathEnd, path_derivatives

MAX_RELATIVE_CONDITION = 0.01  # largest condition number, over 1 / eps


class _NodeSolution(NamedTuple):
    """The equations of motion solved at one node, in object units."""

    x: Float[Array, "*nodes 5"]  # dz/ds
    acceleration: Float[Array, "*nodes 5"]  # of each term of `PathDynamics.acceleration`
    force: Float[Array, "*nodes rows 5"]
    reverse_acceleration: Float[Array, "*nodes 3"]
    condition: Float[Array, "*nodes"]  # of the matrix
    determinant_ratio: Float[Array, "*nodes"]  # positive while friction does not wedge the object


def tabulate_path_dynamics(mechanics: ScaledMechanics, path: ContactPath) -> PathDynamics:
    """Solve the equations of motion at every node of a path, and fit polynomials in `s` to their solution.

    Its status is that of the path, or `singular` where friction wedges the object or the equations are too badly
    conditioned.
    """
    solution, impact_map, contact_inertia = _solve_nodes(mechanics, path)
    is_away = mechanics.contacts.is_away
    if is_away is not None:  # what holds a finger that is away is no contact's force: it counts as the first again
        solution = solution._replace(force=_repeat_first(solution.force, is_away, axis=-2))
        impulses = _repeat_first(impact_map[1:], is_away, axis=0)
        impact_map = jnp.concatenate([impact_map[:1], impulses])
    # Convert to SI units.
    torque, force = mechanics.torque_unit, mechanics.force_unit
    per_term = jnp.stack([jnp.ones_like(torque), jnp.ones_like(torque), jnp.ones_like(torque), 1 / torque, 1 / torque])
    unit = configuration_unit(mechanics.length)
    # Fit geometry apart from dynamics: scenes that differ in friction and mass alone then share the fit of their paths.
    geometry, geometry_error = fit_panels({"configuration": path.nodes * unit, "velocity": solution.x * unit})
    dynamics, dynamics_error = fit_panels(
        {
            "acceleration": solution.acceleration * per_term,
            "reverse_acceleration": solution.reverse_acceleration * per_term[jnp.array([0, 3, 4])],
            "force": solution.force * per_term * force,
        }
    )
    # Judge: friction may change the determinant's sign only by passing through a singular matrix.
    condition = solution.condition.max()
    eps = jnp.finfo(solution.x.dtype).eps
    is_singular = (condition > MAX_RELATIVE_CONDITION / eps) | ~(solution.determinant_ratio.min() > 0)
    return PathDynamics(
        breakpoints=path.breakpoints,
        count=path.count,
        speed_ratio=path.speed_ratio,
        first=path.first,
        panels=path.panels,
        **geometry,
        **dynamics,
        friction_ratio=-mechanics.contacts.friction * path.slip_sign,
        tangential=mechanics.contacts.tangential,
        rolling_friction=jnp.where(mechanics.contacts.tangential, mechanics.contacts.friction, 0.0),
        impact_map=impact_map * jnp.append(1.0, jnp.full(4, force))[:, None] / unit,
        contact_inertia=contact_inertia * force / mechanics.length,
        torque_limit=mechanics.torque_limit,
        ends_at_obstacle=path.end_reason == int(PathEnd.OBSTACLE),
        error=jnp.maximum(geometry_error, dynamics_error),
        condition=condition,
        status=jnp.where(path.status > 0, path.status, jnp.where(is_singular, int(Status.SINGULAR), 0)),
    )


def _repeat_first(values, where: Bool[Array, "rows"], axis: int):
    """Replace rows by the first one."""
    return jnp.where(jnp.expand_dims(where, -1), jnp.take(values, jnp.array([0]), axis=axis), values)


def _solve_nodes(
    mechanics: ScaledMechanics, path: ContactPath
) -> tuple[_NodeSolution, Float[Array, "5 5"], Float[Array, "4 4"]]:
    """Solve the equations of motion at every node (panels, nodes).

    Returns:
        The solution; then, at the path's start, the impact map and the contact-space inertia.
    """
    shape = path.nodes.shape[:2]
    z = jnp.concatenate([path.nodes.reshape(-1, 5), path.start[None]])
    segment = jnp.append(jnp.repeat(path.segment_of_panel, shape[1]), 0)
    chart, slip_sign, joint_sign = path.chart[segment], path.slip_sign[segment], path.joint_sign[segment]
    impact, back, solutions = jax.vmap(lambda *node: _solve_node(mechanics, *node))(z, chart, slip_sign, joint_sign)
    solutions = jax.tree.map(lambda a: a[:-1].reshape(*shape, *a.shape[1:]), solutions)
    # Velocities `back` move one gap each; momentum that they take or give is that of the impulses.
    return solutions, impact[-1], -fused_matmul(impact[-1, 1:], back[-1])


def _solve_node(mechanics: ScaledMechanics, z, u, slip_sign, joint_sign):
    """Solve the equations of motion at `z`, in the chart with direction `u`.

    Returns:
        The map from `z_dot` before an impact to speed and impulses after it (5, 5), velocities that move one gap each
        (5, 4), and the solution.
    """
    local = path_derivatives(mechanics, z, u)
    x, curvature = local.x, local.curvature
    matrix, right = equations_of_motion(mechanics, z, x, curvature, slip_sign, joint_sign)
    reverse_matrix, reverse_right = equations_of_motion(mechanics, z, x, curvature, -slip_sign, -joint_sign)
    inverse, determinant = inverse_and_determinant(matrix)
    # The determinant without friction, det [M x, -G^T] = x.M x det [G; u]: only the part of M x along x counts, as the
    # rest lies in the span of G^T.
    frictionless = stop_gradient(mechanics.inertia @ x**2 * local.determinant)
    determinant_ratio = stop_gradient(determinant) * frictionless
    solution = fused_matmul(inverse, right)
    # In the direction orthogonal to the contacts' wrenches, only M x a is left of the left-hand side.
    normal = null_vector(reverse_matrix[:, 1:].T)
    reverse = fused_matmul(reverse_right[:, jnp.array([0, 3, 4])].T, normal)
    reverse_acceleration = reverse * (normal @ reverse_matrix[:, 0]) / frictionless**2
    condition = jnp.abs(matrix).sum(0).max() * jnp.abs(inverse).sum(0).max()
    found = _NodeSolution(x, solution[0], solution[1:], reverse_acceleration, condition, determinant_ratio)
    return inverse * mechanics.inertia, local.constraint_inverse, found
