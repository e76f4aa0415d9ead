"""Linearisation: all constraints at `p` with first derivatives, and products with them.

Each interval depends on seven variables of its own, so seven directions of forward mode differentiate all intervals.

Derivation: section 9 of `docs/derivation.md`.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int

from wholearm_jax.dynamics import PathDynamics
from wholearm_jax.optimisation.constraints import (
    Limits,
    evaluate_constraints,
    fixed_variables,
    force_count,
    linkage_defects,
)
from wholearm_jax.optimisation.variables import (
    INPUTS,
    Variables,
    interval_end_indices,
    interval_input_indices,
    interval_inputs,
    state_slice,
    variable_count,
)
from wholearm_jax.simulation import IntegratorOptions


class LinearisedProblem(eqx.Module):
    """The constraints at an iterate, with their derivatives."""

    # Inequalities g >= a m, of each part
    inequality: Float[Array, "phases parts inequalities"]  # g
    inequality_jacobian: Float[Array, "phases parts inequalities 7"]  # J, by the interval's inputs
    weight: Float[Array, "phases parts inequalities"]  # w in the barrier; 0: does not exist
    margin_mask: Float[Array, "inequalities"]  # a; 1 for forces, which the margin's level lowers
    interval_of_part: Int[Array, "phases parts"]

    # Equalities e = 0
    defect: Float[Array, "e"]  # e: of all intervals, then `linkage_defects`
    equality_jacobian: Float[Array, "e p"]  # E
    end_jacobian: Float[Array, "phases intervals 2 7"]  # of the states in which intervals end, by their inputs

    is_fixed: Bool[Array, "p"]  # variables that stay

    @property
    def phases(self) -> int:
        return self.end_jacobian.shape[0]

    @property
    def knots(self) -> int:
        return self.end_jacobian.shape[1] + 1

    @property
    def input_indices(self) -> Int[np.ndarray, "phases intervals 7"]:
        """Where in `p` the inputs of each interval stand."""
        return interval_input_indices(self.phases, self.knots)

    @property
    def states(self) -> slice:
        """Where in `p` the states stand."""
        return state_slice(self.phases, self.knots)


def linearise(
    p: Variables, phase_dynamics: PathDynamics, limits: Limits, options: IntegratorOptions
) -> LinearisedProblem:
    """Simulate all intervals, with first derivatives by forward mode.

    Args:
        p: the iterate.
        phase_dynamics: path dynamics of the phases, stacked.
        limits: limits of the phases.
        options: solver of the intervals' steps.
    """
    phases, knots = p.torque.shape[:2]
    q = interval_inputs(p)

    # Differentiate all intervals by each of their inputs.
    def evaluate(q):
        return evaluate_constraints(q, phase_dynamics, limits, options)

    def along(direction):
        return jax.jvp(evaluate, (q,), (jnp.broadcast_to(direction, q.shape),), has_aux=True)

    each_input = jax.vmap(along, out_axes=(None, -1, None))
    values, derivatives, (weight, owner) = each_input(jnp.eye(INPUTS))

    # Defects: the end of an interval less the state at the next knot.
    inputs, ends = interval_input_indices(phases, knots), interval_end_indices(phases, knots)
    row = np.arange(ends.size)
    jacobian = jnp.zeros((ends.size, variable_count(phases, knots)))
    columns = np.repeat(inputs.reshape(-1, INPUTS), 2, axis=0)
    jacobian = jacobian.at[row[:, None], columns].add(derivatives.end.reshape(-1, INPUTS))
    jacobian = jacobian.at[row, ends.ravel()].add(-1.0)
    defect = (values.end - p.state[:, 1:]).ravel()

    # Linkage of the phases.
    flat, unravel = ravel_pytree(p)

    def linkage(flat):
        return linkage_defects(unravel(flat), phase_dynamics)

    return LinearisedProblem(
        inequality=values.inequality,
        inequality_jacobian=derivatives.inequality,
        weight=weight,
        margin_mask=jnp.asarray((np.arange(values.inequality.shape[2]) < force_count(knots)) * 1.0),
        interval_of_part=owner,
        defect=jnp.concatenate([defect, linkage(flat)]),
        equality_jacobian=jnp.concatenate([jacobian, jax.jacfwd(linkage)(flat)]),
        end_jacobian=derivatives.end,
        is_fixed=fixed_variables(limits, phases, knots),
    )


def scatter_add(linear: LinearisedProblem, values: Float[Array, "phases intervals 7"]) -> Float[Array, "p"]:
    """Add numbers of each interval's inputs up to one for each variable; zero for variables that stay."""
    return jnp.where(linear.is_fixed, 0.0, jnp.zeros(linear.is_fixed.shape[0]).at[linear.input_indices].add(values))


def jacobian_product(
    linear: LinearisedProblem, direction: Float[Array, "p"]
) -> Float[Array, "phases parts inequalities"]:
    """Return `J direction`."""
    own = jnp.take_along_axis(direction[linear.input_indices], linear.interval_of_part[..., None], axis=1)
    return jnp.einsum("pkrq,pkq->pkr", linear.inequality_jacobian, own)


def jacobian_transpose_product(
    linear: LinearisedProblem, values: Float[Array, "phases parts inequalities"]
) -> Float[Array, "p"]:
    """Return `J^T values`."""
    of_parts = jnp.einsum("pkr,pkrq->pkq", values, linear.inequality_jacobian)
    return scatter_add(linear, _sum_over_parts(linear, of_parts))


def gauss_newton_blocks(
    linear: LinearisedProblem, values: Float[Array, "phases parts inequalities"]
) -> Float[Array, "phases intervals 7 7"]:
    """Return `J^T diag(values) J`, for each interval's inputs."""
    jacobian = linear.inequality_jacobian
    return _sum_over_parts(linear, jnp.einsum("pkr,pkrq,pkrs->pkqs", values, jacobian, jacobian))


def _sum_over_parts(
    linear: LinearisedProblem, values: Float[Array, "phases parts *rest"]
) -> Float[Array, "phases intervals *rest"]:
    """Add numbers of each part up for its interval."""
    intervals = linear.knots - 1
    further = np.arange(linear.phases)[:, None], linear.interval_of_part[:, intervals:]
    return values[:, :intervals].at[further].add(values[:, intervals:])
