r"""The equations of motion along a path as one linear system (the paper's eqs. 1-4 and 12-16).

With `x = dz/ds`, `x' = d2z/ds2`, `v = ds/dt` and `a = dv/dt`, `z_dot = x v` and `z_ddot = x a + x' v^2`, and

    [ M x , -(G_n - Xi U G_t)^T ] [a ; c_n] = E tau + g - M x' v^2 - B x v - D sgn(x v)

A contact that rolls has no friction law, `Xi = 0`, but one more column `-G_t^T`, whose unknown is its tangential force
`c_t`. Derivation: section 4 of `docs/derivation.md`.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from wholearm_jax.model import ScaledMechanics, constraint_jacobian, tangential_jacobian


def equations_of_motion(
    mechanics: ScaledMechanics,
    z: Float[Array, "5"],
    x: Float[Array, "5"],
    curvature: Float[Array, "5"],
    slip_sign: Float[Array, "rows"],
    joint_sign: Float[Array, "2"],
) -> tuple[Float[Array, "5 5"], Float[Array, "5 5"]]:
    """Assemble the equations of motion at one place of a path, in object units.

    Args:
        mechanics: Mechanics of the formation.
        z: Configuration.
        x: Tangent `dz/ds`.
        curvature: `x' = d2z/ds2`.
        slip_sign: Signs of sliding, `Xi`.
        joint_sign: Signs of the joint velocities.

    Returns:
        The matrix of the unknowns `(a, c_1, ..., c_4)`, and the right-hand sides for the terms
        `(1, v^2, v, tau1, tau2)`, one a column.
    """
    friction = (mechanics.contacts.friction * slip_sign)[:, None] * tangential_jacobian(mechanics.contacts, z)
    wrench = (constraint_jacobian(mechanics.contacts, z) - friction).T
    matrix = jnp.concatenate([(mechanics.inertia * x)[:, None], -wrench], axis=1)
    none, weight = jnp.zeros(3, z.dtype), mechanics.inertia[0] * mechanics.gravity
    dry = jnp.concatenate([weight, jnp.zeros(1, z.dtype), -mechanics.dry * joint_sign])
    viscous = jnp.concatenate([none, -mechanics.viscous * x[3:]])
    torque = jnp.eye(5, dtype=z.dtype)[3:]
    return matrix, jnp.stack([dry, -mechanics.inertia * curvature, viscous, *torque], axis=1)
