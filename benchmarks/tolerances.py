"""One compiled program for all tolerances."""

import diffrax as dfx
import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from wholearm_jax.motion import Integration


class AnyTolerance(eqx.Module):
    """What `wholearm_jax.Integration` says, with a tolerance that is data rather than part of the program."""

    tolerance: Float[Array, ""]
    solver: dfx.AbstractSolver = eqx.field(static=True)
    max_steps: int = eqx.field(static=True)
    stages: int = eqx.field(static=True)
    steps: bool = eqx.field(static=True)
    adjoint: str = eqx.field(static=True)


def any_tolerance(tolerance, **rest) -> AnyTolerance:
    """`Integration(tolerance=tolerance, **rest)` with the tolerance as data."""
    how = Integration(**rest)
    return AnyTolerance(jnp.asarray(tolerance), how.solver, how.max_steps, how.stages, how.steps, how.adjoint)
