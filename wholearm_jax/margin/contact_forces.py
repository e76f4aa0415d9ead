"""Contact forces of a motion, and their slacks: what counts toward the margin.

The slack [N] of a constraint's force is `c_n` itself and, in the tangential row of a contact that rolls, how far the
force is inside its friction cone, `mu c_n - |c_t|`. Derivation: section 7 of `docs/derivation.md`.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from wholearm_jax.dynamics import PathDynamics, evaluate_dot, locate_panel
from wholearm_jax.simulation import Actuation, DenseOutput, evaluate_dense, evaluate_memory, torque_of

SAMPLES_PER_STEP = 7  # places in a step at which forces are sampled before the minimum is refined
MAX_ROLLING = 2  # contacts of a formation that can roll: 2R + S = 4


def contact_force(
    dynamics: PathDynamics, phase_schedule: Actuation, duration, segment, row, phase_time, s, w, memory=None
) -> Float[Array, "rows"]:
    """Evaluate the constraint forces [N] for forward travel: `c_n`, or `c_t` in tangential rows.

    `memory` is what a closed-loop law remembers.
    """
    panel, xi = locate_panel(dynamics, segment, s)
    v = w / duration
    terms = jnp.stack([jnp.ones_like(v), v**2, v])
    terms = jnp.concatenate([terms, torque_of(phase_schedule, row, phase_time, memory)])
    return evaluate_dot(dynamics.force, panel, xi, terms)


def force_slack(dynamics: PathDynamics, forces: Float[Array, "rows"]) -> Float[Array, "rows"]:
    """Compute the slacks of constraint forces [N]: `c_n`, or `mu c_n - |c_t|` in tangential rows."""
    normal_forces = jnp.roll(forces, 1)  # in tangential rows: a contact's normal row stands just before
    cone = dynamics.rolling_friction * normal_forces - jnp.abs(forces)
    return jnp.where(dynamics.tangential, cone, forces)


def cone_facets(
    dynamics: PathDynamics, forces: Float[Array, "rows *terms"], rolling: int = MAX_ROLLING
) -> Float[Array, "facets *terms"]:
    """Compute linear functions of the forces whose minimum is that of `force_slack`: both sides of each friction cone.

    Args:
        dynamics: Tabulated path dynamics.
        forces: Constraint forces, or their coefficients in any linear terms.
        rolling: Largest number of contacts that roll.

    Returns:
        The slacks of one side of every cone, then those of the other side for `rolling` contacts; where fewer roll, the
        first slack again (`is_duplicate_facet`).
    """
    column = (slice(None), *(None,) * (forces.ndim - 1))
    normal = dynamics.rolling_friction[column] * jnp.roll(forces, 1, axis=0)
    one_side = jnp.where(dynamics.tangential[column], normal - forces, forces)
    (rows,) = jnp.nonzero(dynamics.tangential, size=rolling, fill_value=-1)
    other_side = jnp.where((rows >= 0)[column], (normal + forces)[rows], forces[0])
    return jnp.concatenate([one_side, other_side])


def is_duplicate_facet(dynamics: PathDynamics) -> Bool[Array, "rows"]:
    """Say which of `cone_facets` repeat another."""
    rows = dynamics.tangential.shape[0]
    return jnp.arange(rows + MAX_ROLLING) >= rows + dynamics.tangential.sum()


def slacks_at(
    dynamics: PathDynamics, phase_schedule: Actuation, duration, step: DenseOutput, xi, kind=force_slack
) -> Float[Array, "rows"]:
    """Evaluate `force_slack` (or `cone_facets`) at `xi` in [0, 1] of one step."""
    phase_time, s, w = evaluate_dense(step, xi)
    at = step.segment, step.row, phase_time, s, w, evaluate_memory(step, xi)
    return kind(dynamics, contact_force(dynamics, phase_schedule, duration, *at))


def sampled_slacks(
    dynamics: PathDynamics,
    phase_schedule: Actuation,
    duration,
    steps: DenseOutput,
    samples: int = SAMPLES_PER_STEP,
    kind=force_slack,
) -> Float[Array, "steps samples rows"]:
    """Evaluate `force_slack` (or `cone_facets`) at uniform places of every step, both ends included.

    Slacks of steps at rest are infinite: forces are not determined there.
    """
    xi = jnp.linspace(0.0, 1.0, samples, dtype=steps.quintic.dtype)
    on = partial(slacks_at, kind=kind)
    at = jax.vmap(jax.vmap(on, (None, None, None, None, 0)), (None, None, None, 0, None))
    values = at(dynamics, phase_schedule, duration, steps, xi)
    return jnp.where((steps.live & ~steps.at_rest)[:, None, None], values, jnp.inf)
