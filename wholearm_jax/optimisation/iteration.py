"""One iteration of the solver: simulate and linearise, accept or shorten the last step, take the next one.

A step is shortened where it leads to what cannot be simulated or, while the merit is monitored, raises the merit
function by more than `merit_tolerance`: the barrier objective with an exact penalty on the equations.

Source of the penalty: J. Nocedal and S. J. Wright, Numerical Optimization, 2006, chapter 18.
Derivation: section 9 of `docs/derivation.md`.
"""

import math
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from wholearm_jax.core import CachedJit
from wholearm_jax.dynamics import PathDynamics
from wholearm_jax.margin import log_barrier_minimum
from wholearm_jax.optimisation.constraints import Limits
from wholearm_jax.optimisation.linearisation import LinearisedProblem, linearise
from wholearm_jax.optimisation.retraction import retract
from wholearm_jax.optimisation.variables import Variables
from wholearm_jax.simulation import IntegratorOptions

STEP_REDUCTION = 0.25  # factor of a step that is taken again
MIN_REJECTED_STEP = 1e-3  # fraction of a step below which the merit no longer rejects it
LINEAR_LOG_BELOW = 1e-3  # slack below which the merit's logarithm goes on as its tangent
DEFECT_TOL = 1e-9  # sum of the defects below which the intervals count as joined


class SolverState(eqx.Module):
    """State of the solver between iterations."""

    # Iterate
    p: Variables
    optimiser: Any  # the method's state, `OptimiserState`

    # Last step, kept to shorten it
    previous: Variables
    direction: Variables
    step_fraction: Float[Array, ""]  # of the direction; 1: not shortened

    # Diagnostics at `previous`; NaN after a rejected step
    min_force: Float[Array, "phases"]  # smallest sampled force of each phase, over its force scale
    defect_norm: Float[Array, ""]  # |e|_1

    # Step control, from `solver`
    step_scale: Float[Array | np.ndarray, ""]  # factor of every step
    merit_tolerance: Float[
        Array | np.ndarray, ""
    ]  # most by which a step may raise the merit; infinite: merit not computed
    regularisation: Float[Array | np.ndarray, ""]  # of the interior point's system

    # Merit at `previous`, and the barrier parameter that it holds for
    merit: Float[Array, ""]
    mu: Float[Array, ""]


def merit_function(linear: LinearisedProblem, mu, max_multiplier) -> Float[Array, ""]:
    """Return the merit: minus the smooth margin, barriers of the limits, and `2 max_multiplier |e|_1`.

    Below a small slack, also where it is negative as at a start, logarithms are continued by their tangents.
    """
    mask = linear.margin_mask
    margin, _ = log_barrier_minimum(linear.inequality, linear.weight * mask, mu)
    weight = linear.weight * (1 - mask)
    slack = jnp.where(weight > 0, linear.inequality, 1.0)
    edge = LINEAR_LOG_BELOW
    log = jnp.where(slack > edge, jnp.log(jnp.maximum(slack, edge)), math.log(edge) + (slack - edge) / edge)
    return -margin - mu * (weight * log).sum() + 2 * max_multiplier * defect_norm(linear)


def defect_norm(linear: LinearisedProblem) -> Float[Array, ""]:
    return jnp.abs(linear.defect).sum()


@CachedJit
def init_solver(p: Variables, optimiser) -> SolverState:
    """Return the state before the first step of a method, `interior_point` or `projected_gradient`."""
    zero, infinite = jnp.zeros(()), jnp.zeros(()) + jnp.inf
    state = optimiser.init(ravel_pytree(p)[0])
    return SolverState(
        p=p,
        optimiser=state,
        previous=p,
        direction=jax.tree.map(jnp.zeros_like, p),
        step_fraction=zero + 1,
        min_force=0 * p.log_duration,
        defect_norm=zero,
        step_scale=zero + 1,
        merit_tolerance=infinite,
        regularisation=zero,
        merit=infinite,
        mu=state.mu,
    )


@CachedJit
def take_step(
    d: SolverState, phase_dynamics: PathDynamics, limits: Limits, options: IntegratorOptions, optimiser
) -> SolverState:
    """Simulate `d.p` and step on from it; where it cannot be simulated or is worse, go back and take a shorter step."""
    linear = linearise(d.p, phase_dynamics, limits, options)
    is_finite = jnp.all(jnp.isfinite(linear.inequality)) & jnp.all(jnp.isfinite(linear.defect))
    monitors_merit = jnp.isfinite(d.merit_tolerance)

    def is_better():
        return merit_function(linear, d.mu, d.optimiser.max_multiplier) <= d.merit + d.merit_tolerance

    is_better_or_unmonitored = jax.lax.cond(monitors_merit, is_better, lambda: monitors_merit | True)
    is_force = (linear.weight > 0) & (linear.margin_mask > 0)
    min_force = jnp.where(is_force, linear.inequality, jnp.inf).min((1, 2))
    norm = defect_norm(linear)

    def accept() -> SolverState:
        flat, unravel = ravel_pytree(d.p)
        gradient = jnp.zeros_like(flat)  # each method makes its own
        step, state = optimiser.update(gradient, d.optimiser, flat, linear=linear, regularisation=d.regularisation)
        mu = d.optimiser.mu

        def merit_here():
            return merit_function(linear, mu, state.max_multiplier)

        return replace(
            d,
            optimiser=state,
            previous=d.p,
            direction=unravel(step),
            step_fraction=jnp.ones(()),
            min_force=min_force,
            defect_norm=norm,
            merit=jax.lax.cond(monitors_merit, merit_here, lambda: jnp.full_like(d.merit, jnp.inf)),
            mu=mu,
        )

    def shorten() -> SolverState:
        unknown = {name: jnp.full_like(getattr(d, name), jnp.nan) for name in ("min_force", "defect_norm")}
        return replace(d, step_fraction=d.step_fraction * STEP_REDUCTION, **unknown)

    is_accepted = is_finite & (is_better_or_unmonitored | (d.step_fraction < MIN_REJECTED_STEP))
    after = jax.lax.cond(is_accepted, accept, shorten)
    length = after.step_fraction * after.step_scale
    return replace(after, p=retract(after.previous, after.direction, length, phase_dynamics, limits))
