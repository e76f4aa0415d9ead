"""Derivatives of accepted steps: the steps are taken again as they were chosen, forward or on the way back."""

from collections.abc import Callable

import diffrax as dfx
import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Float

from wholearm_jax.core import take_row
from wholearm_jax.simulation.closed_loop import Actuation
from wholearm_jax.simulation.integrator import AcceptedSteps, integrate_adaptive
from wholearm_jax.simulation.integrator_options import IntegratorOptions, differentiable_solver


def replay_steps(
    field: Callable, phase_schedule: Actuation, options: IntegratorOptions, begin, final, y, steps: AcceptedSteps
) -> AcceptedSteps:
    """Take the steps of `integrate_adaptive` again, differentiably; those that end on a knot move with it."""
    count, row = steps.count, steps.row
    # A batch loops until its last member is done: the others take steps of no length.
    ends = _step_ends(phase_schedule, steps, final)
    ends = jnp.where(jnp.arange(options.max_steps) < count, ends, ends[jnp.maximum(count - 1, 0)])
    ends = jnp.where(count > 0, ends, begin)
    begins = jnp.concatenate([begin[None], ends[:-1]])
    solver, term = differentiable_solver(options), dfx.ODETerm(field)
    jumps = jnp.append(False, row[1:] != row[:-1])

    def step(state):
        k, y, solver_state, ys = state
        made_jump = take_row(jumps, k) if options.has_jumps else False
        y, _, _, solver_state, _ = solver.step(
            term, take_row(begins, k), take_row(ends, k), y, take_row(row, k), solver_state, made_jump
        )
        return k + 1, y, solver_state, ys.at[k].set(y)

    rows = jnp.zeros_like(steps.y)  # not `y`: what a row of a buffer holds before it is written keeps its derivative
    start = jnp.asarray(0, int), y, solver.init(term, begin, ends[0], y, row[0]), rows
    *_, ys = eqxi.while_loop(
        lambda state: state[0] < count,
        step,
        start,
        max_steps=options.max_steps,
        buffers=lambda state: state[3],
        kind=options.adjoint.loop_kind,
    )
    return steps._replace(end=ends, y=ys)


def _step_ends(phase_schedule: Actuation, steps: AcceptedSteps, final) -> Float[Array, "steps"]:
    """Return where steps end: on a knot, which may move, or at a fixed time."""
    knot = phase_schedule.phase_time[steps.row + 1]
    return jnp.where((steps.end == stop_gradient(knot)) & (steps.end < final), knot, stop_gradient(steps.end))


@eqx.filter_custom_vjp
def integrate_with_replay_adjoint(
    inputs, field_of: Callable, event_of: Callable, options: IntegratorOptions, final, limits, distance
) -> AcceptedSteps:
    """Integrate as `integrate_adaptive`, with a reverse mode that goes back over the accepted steps.

    Each step is computed once more on the way back, from the state where it began, and none on the way there.

    Args:
        inputs: `(parameters, phase_schedule, begin, y)`: all that the result can be differentiated by.
        field_of: `field_of(parameters, phase_schedule)` is the field of `integrate_adaptive`.
        event_of: `event_of(limits)` is its terminal event.
        options: Options of the integrator.
        final: Phase time at which the integration ends.
        limits: Parameters of the event.
        distance: Distance of `s` from the event.
    """
    parameters, phase_schedule, begin, y = inputs
    field, event = field_of(parameters, phase_schedule), event_of(limits)
    return integrate_adaptive(field, phase_schedule, options, begin, final, y, event, distance)


@integrate_with_replay_adjoint.def_fwd
def _replay_forward(_, inputs, *others):
    # Second derivatives are refused: they would miss how the states between steps move.
    steps = integrate_with_replay_adjoint(eqxi.nondifferentiable(inputs), *others)
    return steps, steps


@integrate_with_replay_adjoint.def_bwd
def _replay_backward(
    steps: AcceptedSteps,
    gradient: AcceptedSteps,
    perturbed,
    inputs,
    field_of,
    event_of,
    options,
    final,
    limits,
    distance,
):
    """Pull the gradient of the steps' ends and states back to the inputs, from the last step to the first."""
    parameters, phase_schedule, begin, y = inputs
    differentiated, constant = eqx.partition((parameters, phase_schedule, begin), perturbed[:3])
    solver = differentiable_solver(options)
    begin_states = jnp.concatenate([y[None], steps.y[:-1]])
    end_gradients, y_gradients = (
        jnp.zeros_like(value) if cotangent is None else cotangent
        for value, cotangent in zip((steps.end, steps.y), (gradient.end, gradient.y), strict=True)
    )

    def step(differentiated, y, k):
        parameters, phase_schedule, begin = eqx.combine(differentiated, constant)
        ends = _step_ends(phase_schedule, steps, final)
        begin = jnp.where(k > 0, take_row(ends, jnp.maximum(k - 1, 0)), begin)
        term, end, row = dfx.ODETerm(field_of(parameters, phase_schedule)), take_row(ends, k), take_row(steps.row, k)
        solver_state = solver.init(term, begin, end, y, row)
        return end, solver.step(term, begin, end, y, row, solver_state, made_jump=False)[0]

    def pull_back(state):
        k, y_gradient, total = state
        _, pull = jax.vjp(lambda inputs, y: step(inputs, y, k), differentiated, take_row(begin_states, k))
        input_gradient, y_gradient = pull((take_row(end_gradients, k), y_gradient + take_row(y_gradients, k)))
        return k - 1, y_gradient, jax.tree.map(jnp.add, total, input_gradient)

    start = steps.count - 1, jnp.zeros_like(y), jax.tree.map(jnp.zeros_like, differentiated)
    _, y_gradient, total = jax.lax.while_loop(lambda state: state[0] >= 0, pull_back, start)
    return *total, y_gradient
