"""The inelastic impact at which a phase is entered with speed.

Derivation: section 5 of `docs/derivation.md`.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from wholearm_jax.dynamics.path_dynamics import PathDynamics


class Impact(NamedTuple):
    """The result of an impact."""

    speed: Float[Array, ""]  # ds/dt after it [1/s]
    impulse: Float[Array, "rows"]  # of each constraint [N s]
    size: Float[Array, ""]  # largest sum of magnitudes that makes up an impulse: the scale of its rounding [N s]


def resolve_impact(dynamics: PathDynamics, z_dot: Float[Array, "5"]) -> Impact:
    """Compute the speed and the impulses after the impact by which a formation replaces another one.

    Velocities after the impact are `x v`, along the new path; impulses `p` obey the friction of forward travel:

        [ M x , -(G_n - Xi U G_t)^T ] [v ; p] = M z_dot

    the equations of motion with momenta in place of forces. Kinetic energy does not grow: with compressive `p`, the
    loss is the kinetic energy of `x v - z_dot` and the work of friction.

    Args:
        dynamics: Path dynamics of the formation that is entered.
        z_dot: Velocity before the impact [m/s, rad/s].
    """
    after = dynamics.impact_map @ z_dot
    return Impact(after[0], after[1:], (jnp.abs(dynamics.impact_map) @ jnp.abs(z_dot))[1:].max())
