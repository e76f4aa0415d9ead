"""Projected gradient: any optax optimiser in place of the interior point, and the protocol that both follow.

The solver (`iteration`) calls `init(p)` with the flattened variables, and at each iterate

    step, state = update(gradient, state, p, linear=LinearisedProblem, regularisation=...)

where `gradient` is zero: a method makes its own from `linear`. Its state has the fields of `OptimiserState`.
"""

from typing import NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float

from wholearm_jax.margin import log_barrier_minimum
from wholearm_jax.optimisation.interior_point import MU_MAX, MU_MIN, fraction_to_boundary, step_cap
from wholearm_jax.optimisation.linearisation import LinearisedProblem, jacobian_product, jacobian_transpose_product
from wholearm_jax.optimisation.riccati import project_step


@runtime_checkable
class OptimiserState(Protocol):
    """What the solver reads of a method's state."""

    @property
    def mu(self) -> Float[Array, ""]:
        """Barrier parameter, over the force scale."""
        ...

    @property
    def mu_min(self) -> Float[Array, ""]:
        """The least that it may become: the solver stops there only."""
        ...

    @property
    def step_lengths(self) -> Float[Array, "2"]:
        """Fractions of the last step that were taken, primal and dual."""
        ...

    @property
    def max_multiplier(self) -> Float[Array, ""]:
        """Largest multiplier of the equalities: half the merit function's penalty."""
        ...


class ProjectedGradientState(NamedTuple):
    """State of `projected_gradient`; its steps keep the linearised equations, which have no multipliers."""

    inner: optax.OptState
    level: Float[Array, ""]  # m of the smooth margin, over the force scale
    mu: Float[Array, ""]
    mu_min: Float[Array, ""]
    step_lengths: Float[Array, "2"]
    max_multiplier: Float[Array, ""]


def projected_gradient(
    optimiser: optax.GradientTransformation, mu_factor: float = 0.98
) -> optax.GradientTransformationExtraArgs:
    """Let an optax optimiser change torques and durations, its updates projected onto the linearised equations.

    Args:
        optimiser: sees the gradient of minus the smooth margin by torques and durations.
        mu_factor: factor of the barrier parameter from one step to the next.
    """
    optimiser = optax.with_extra_args_support(optimiser)

    def init(params):
        level, mu, mu_min = (jnp.full((), value) for value in (jnp.nan, MU_MAX, MU_MIN))
        return ProjectedGradientState(optimiser.init(params), level, mu, mu_min, jnp.zeros(2), jnp.zeros(()))

    def update(updates, state: ProjectedGradientState, params=None, *, linear: LinearisedProblem, **extra):
        mu, mask = state.mu, linear.margin_mask
        _, level = log_barrier_minimum(linear.inequality, linear.weight * mask, mu)

        # The gradient; outside a limit, where the loss is infinite, as with a small slack.
        slack = linear.inequality - mask * level
        ascent = jacobian_transpose_product(linear, mu * linear.weight / jnp.maximum(slack, mu))
        closed = eqx.tree_at(lambda each: each.defect, linear, jnp.zeros_like(linear.defect))
        gradient = project_step(closed, -ascent).at[linear.states].set(0.0)

        # The projected update, as much of it as stays within limits.
        updates, inner = optimiser.update(gradient, state.inner, params, **extra)
        step = project_step(linear, jnp.asarray(updates).at[linear.states].set(0.0))
        is_limit = (linear.weight > 0) & (mask == 0) & (linear.inequality > 0)
        value = jnp.where(is_limit, linear.inequality, 1.0)
        change = jnp.where(is_limit, jacobian_product(linear, step), 0.0)
        length = jnp.minimum(fraction_to_boundary(value, change), step_cap(linear, step))

        mu = jnp.maximum(mu_factor * mu, state.mu_min)
        lengths = jnp.stack([length, length])
        return length * step, ProjectedGradientState(inner, level, mu, state.mu_min, lengths, state.max_multiplier)

    return optax.GradientTransformationExtraArgs(init, update)  # pyright: ignore[reportArgumentType]
