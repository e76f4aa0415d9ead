r"""Primal-dual interior point: the Newton direction of the barrier problem, as an optax transformation.

With inequalities `g(p)`, weights `w` and the mask `a` of those that the margin's level `m` lowers (forces), a step
maximises the smooth margin at the barrier parameter `mu`,

    max over p and m of  m + mu sum_i w_i log z_i,    z = g(p) - a m,    e(p) = 0

whose optimum lies less than `mu` times the sum of weights below the largest margin. The slacks `z` and multipliers
`y`, with `y z = mu w`, are unknowns of their own. The second derivatives of the simulation are left out (Gauss-Newton).
While steps are long, `mu` falls; where limits leave only tiny ones, it rises again.

Source: J. Nocedal and S. J. Wright, Numerical Optimization, 2006, chapter 19.
Derivation: section 9 of `docs/derivation.md`.
"""

from typing import NamedTuple

import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int

from wholearm_jax.optimisation.constraints import inequality_count
from wholearm_jax.optimisation.linearisation import LinearisedProblem, jacobian_product
from wholearm_jax.optimisation.riccati import kkt_step
from wholearm_jax.optimisation.variables import knot_count

MU_MAX, MU_MIN = 0.1, 1e-4  # barrier parameters, over the force scale
BOUNDARY_FRACTION = 0.95  # of the way to a limit that a step may go
INITIAL_SLACK = 0.05  # smallest slack that an inequality starts with
MAX_STATE_CHANGE = (0.1, 0.5)  # largest changes of `s` and `v` at a knot in a step, in their units in `Variables`
STALL_STEP = 0.02  # fraction of a step below which limits count as blocking it
MU_FACTORS = ((0.5, 0.2), (0.2, 0.6), (STALL_STEP, 1.0))  # (fraction of the step taken, factor of `mu` above it)
MU_INCREASE = 3.0  # factor of `mu` at a blocked step
MU_MIN_INCREASE, MU_MIN_MAX = 4.0, 0.01  # factor of the least `mu` at a blocked step close to it, and its largest


class InteriorPointState(NamedTuple):
    """State of the interior point."""

    # Unknowns
    slack: Float[Array, "phases parts inequalities"]  # z
    multiplier: Float[Array, "phases parts inequalities"]  # y; 0: not yet chosen
    interval_of_part: Int[Array, "phases parts"]  # intervals to which these parts belonged
    level: Float[Array, ""]  # m, over the force scale; NaN: not yet chosen

    # Barrier
    mu: Float[Array, ""]  # over the force scale
    mu_min: Float[Array, ""]  # the least that it may become

    # Last step
    step_lengths: Float[Array, "2"]  # fractions taken of the primal and the dual step
    max_multiplier: Float[Array, ""]  # largest multiplier of the equalities


class _Direction(NamedTuple):
    """A Newton step of all unknowns."""

    p: Float[Array, "p"]
    level: Float[Array, ""]
    slack: Float[Array, "phases parts inequalities"]
    multiplier: Float[Array, "phases parts inequalities"]
    equality_multipliers: Float[Array, "e"]  # values, not changes


def interior_point(phases: int, extra_parts: int, hand_over_rows: int = 0) -> optax.GradientTransformationExtraArgs:
    """Build the transformation; its `update` needs `linear` and `regularisation`, and ignores the gradient.

    Args:
        phases: number of phases.
        extra_parts: number of parts that intervals may have beyond one each (`multiple_shooting.extra_parts`).
        hand_over_rows: number of those of each interval.
    """

    def init(params):
        knots = knot_count(params.shape[0], phases)
        shape = (phases, knots - 1 + extra_parts, inequality_count(knots, hand_over_rows))
        level, mu, mu_min = (jnp.full((), value) for value in (jnp.nan, MU_MAX, MU_MIN))
        owner = jnp.zeros(shape[:2], int)
        return InteriorPointState(
            jnp.ones(shape), jnp.zeros(shape), owner, level, mu, mu_min, jnp.zeros(2), jnp.zeros(())
        )

    def update(updates, state: InteriorPointState, params=None, *, linear: LinearisedProblem, regularisation, **_):
        level, slack, multiplier = _begin_unknowns(state, linear)
        step = _newton_direction(linear, level, slack, multiplier, state.mu, regularisation)
        primal = jnp.minimum(fraction_to_boundary(slack, step.slack), step_cap(linear, step.p))
        dual = fraction_to_boundary(multiplier, step.multiplier)
        mu, mu_min = _update_barrier(state, jnp.minimum(primal, dual))
        state = InteriorPointState(
            slack=slack + primal * step.slack,
            multiplier=multiplier + dual * step.multiplier,
            interval_of_part=linear.interval_of_part,
            level=level + primal * step.level,
            mu=mu,
            mu_min=mu_min,
            step_lengths=jnp.stack([primal, dual]),
            max_multiplier=jnp.abs(step.equality_multipliers).max(),
        )
        return primal * step.p, state

    return optax.GradientTransformationExtraArgs(init, update)  # pyright: ignore[reportArgumentType]


def _begin_unknowns(state: InteriorPointState, linear: LinearisedProblem):
    """Return level, slacks and multipliers before a step.

    They are chosen anew at the first step, and where a part belongs to another interval than before.
    """
    exists, mask = linear.weight > 0, linear.margin_mask
    min_force = jnp.where(exists & (mask > 0), linear.inequality, jnp.inf).min()
    level = jnp.where(jnp.isnan(state.level), min_force - 2 * INITIAL_SLACK, state.level)
    value = jnp.where(exists, linear.inequality - mask * level, 1.0)
    changed_owner = state.interval_of_part != linear.interval_of_part
    is_new = ~(state.multiplier > 0) | changed_owner[..., None]
    slack = jnp.where(exists, jnp.maximum(value, jnp.where(is_new, INITIAL_SLACK, state.slack)), 1.0)
    on_central_path = state.mu * linear.weight / slack
    multiplier = jnp.where(exists, jnp.where(is_new, on_central_path, state.multiplier), 0.0)
    return level, slack, multiplier


def _newton_direction(linear: LinearisedProblem, level, slack, multiplier, mu, regularisation) -> _Direction:
    """Solve for the Newton step: slacks and multipliers are eliminated, `kkt_step` gives the others."""
    exists, mask = linear.weight > 0, linear.margin_mask
    residual = jnp.where(exists, linear.inequality - mask * level, 1.0) - slack
    target = mu * linear.weight / slack
    barrier_hessian = multiplier / slack
    barrier_rhs = jnp.where(exists, target - barrier_hessian * residual, 0.0)
    p, dlevel, equality_multipliers = kkt_step(linear, barrier_hessian, barrier_rhs, regularisation)
    dslack = jnp.where(exists, jacobian_product(linear, p) - mask * dlevel + residual, 0.0)
    dmultiplier = jnp.where(exists, target - multiplier - barrier_hessian * dslack, 0.0)
    return _Direction(p, dlevel, dslack, dmultiplier, equality_multipliers)


def _update_barrier(state: InteriorPointState, step_length) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Choose the next `mu` and the least one: the longer the step, the more `mu` falls.

    After a blocked step it rises; if it was close to the least one, that rises as well.
    """
    above, factors = zip(*MU_FACTORS, strict=True)
    factor = jnp.select([step_length > fraction for fraction in above], list(factors), MU_INCREASE)
    blocked_at_min = (step_length < STALL_STEP) & (state.mu < 2 * state.mu_min)
    raised = jnp.minimum(MU_MIN_INCREASE * state.mu_min, MU_MIN_MAX)
    mu_min = jnp.where(blocked_at_min, raised, state.mu_min)
    return jnp.clip(state.mu * factor, mu_min, MU_MAX), mu_min


def fraction_to_boundary(value, change) -> Float[Array, ""]:
    """Return the largest fraction of a change, at most 1, that keeps every value positive, with some distance to 0."""
    falls = change < 0
    to_zero = jnp.where(falls, -value / jnp.where(falls, change, 1.0), jnp.inf).min()
    return jnp.minimum(1.0, BOUNDARY_FRACTION * to_zero)


def step_cap(linear: LinearisedProblem, direction: Float[Array, "p"]) -> Float[Array, ""]:
    """Return the fraction of a step that keeps the states' changes within `MAX_STATE_CHANGE`."""
    change = jnp.abs(direction[linear.states].reshape(-1, 2)).max(0)
    return (jnp.array(MAX_STATE_CHANGE) / jnp.maximum(change, 1e-30)).min()
