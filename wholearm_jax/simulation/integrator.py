"""Adaptive integration from knot to knot of a torque schedule, until time is over or a terminal event.

The loop is the package's own, around diffrax's solvers and step-size controller. Every step lies in one interval of the
schedule, which is looked up once a step and not at each stage, and only what a motion needs is compiled;
`benchmarks/skipping.py` compares it with `diffrax.diffeqsolve`. Derivation: section 6 of `docs/derivation.md`.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax as dfx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from wholearm_jax.core import take_row
from wholearm_jax.model import interval
from wholearm_jax.simulation.closed_loop import Actuation
from wholearm_jax.simulation.integrator_options import IntegratorOptions, solver_with_loop

MAX_FIRST_STEP = 1 / 32  # of the phase


class AcceptedSteps(NamedTuple):
    """The accepted steps of an integration; rows beyond `count` have no meaning."""

    end: Float[Array, "steps"]  # phase time at the end of each step
    row: Int[Array, "steps"]  # interval of the schedule in which it lies
    y: Float[Array, "steps state"]  # state at its end
    count: Int[Array, ""]
    passed: Bool[Array, ""]  # whether the last step passes the terminal event
    complete: Bool[Array, ""]  # whether the event or the end of time was reached within `max_steps`


class TerminalEvent(NamedTuple):
    """What ends an integration, as two tests."""

    is_past: Callable  # is_past(y): whether a state lies beyond the event
    may_cross_within: Callable
    """`may_cross_within(y_begin, y_end, rates, width)`: whether a step between two states that are not past may be past
    in between. `rates` are `dy/du` at both ends times the step's width."""


class _IntegratorState(NamedTuple):
    """State of the loop: the step to try next."""

    # step to try
    begin: Float[Array, ""]  # phase time
    end: Float[Array, ""]  # phase time
    size: Float[Array, ""]  # its length if no knot had cut it short
    row: Int[Array, ""]  # interval of the schedule
    y: Float[Array, "state"]  # state at `begin`

    # solver
    made_jump: Bool[Array, ""] | bool  # whether the field jumps at `begin`
    solver_state: tuple
    controller_state: tuple
    attempts: Int[Array, ""]

    # output
    steps: AcceptedSteps


class _Method(NamedTuple):
    """The solver, its equation, the order of its error, and the step-size controller."""

    solver: dfx.AbstractSolver
    term: dfx.ODETerm
    order: Any
    controller: dfx.PIDController


def integrate_adaptive(
    field: Callable,
    phase_schedule: Actuation,
    options: IntegratorOptions,
    begin: Float[Array, ""],
    final: Float[Array, ""],
    y: Float[Array, "state"],
    event: TerminalEvent,
    distance: Float[Array, ""],
) -> AcceptedSteps:
    """Integrate from `begin` to `final`, or to the end of the first step that passes a terminal event.

    Not differentiable: see `replay_steps` and `integrate_with_replay_adjoint`.

    Args:
        field: `field(phase_time, y, row)` is `dy/du` in an interval of the schedule.
        phase_schedule: Schedule on whose knots steps end.
        options: Options of the integrator.
        begin: Phase time of the first step.
        final: Phase time at which the integration ends.
        y: State at `begin`.
        event: Terminal event. A step that may pass it in between is taken again with half its length.
        distance: Distance of `s` from the event: the first step covers at most half of it at the speed at `begin`.
    """
    method = _method(field, options)

    def attempt(state: _IntegratorState) -> _IntegratorState:
        # Try a step.
        y, error, dense, solver_state, _ = method.solver.step(
            method.term, state.begin, state.end, state.y, state.row, state.solver_state, state.made_jump
        )
        error = jnp.asarray(error)
        error = jnp.where(jnp.isnan(error), jnp.inf, error)
        # Accept it by its error, unless it may have passed the event in between: then halve it.
        accepted, *span, _, controller_state, _ = method.controller.adapt_step_size(
            state.begin, state.end, state.y, y, None, error, method.order, state.controller_state
        )
        rates = _end_rates(method.solver, field, state, y, dense)
        halved = accepted & event.may_cross_within(state.y, y, rates, state.end - state.begin)
        accepted = accepted & ~halved
        half = state.begin, (state.begin + state.end) / 2, state.controller_state
        begin, end, controller_state = jax.tree.map(
            lambda a, b: jnp.where(halved, a, b), half, (*span, controller_state)
        )
        # Choose the next step: that a knot cut this one short is no reason to shorten it.
        size = jnp.where(accepted, jnp.maximum(end - begin, state.size), end - begin)
        row = interval(phase_schedule, begin)
        steps = _record(state, accepted, y, event)
        y, solver_state = jax.tree.map(
            lambda new, old: jnp.where(accepted, new, old), (y, solver_state), (state.y, state.solver_state)
        )
        made_jump = jnp.where(accepted, row != state.row, state.made_jump) if options.has_jumps else False
        end = _step_end(phase_schedule, final, begin, size, row)
        attempts = state.attempts + 1
        return _IntegratorState(begin, end, size, row, y, made_jump, solver_state, controller_state, attempts, steps)

    def continues(state: _IntegratorState):
        return (state.begin < final) & ~state.steps.passed & (state.attempts < options.max_steps)

    start = _initial_state(method, phase_schedule, options, begin, final, y, distance)
    last = jax.lax.while_loop(continues, attempt, start)
    return last.steps._replace(complete=(last.begin >= final) | last.steps.passed)


def _method(field: Callable, options: IntegratorOptions) -> _Method:
    """Choose solver and step-size controller."""
    solver, term = solver_with_loop(options.solver, "lax"), dfx.ODETerm(field)
    order = solver.error_order(term)
    assert order is not None  # it may be for stochastic solvers
    return _Method(solver, term, order, dfx.PIDController(rtol=options.tolerance, atol=options.tolerance))


def _initial_state(
    method: _Method, phase_schedule: Actuation, options: IntegratorOptions, begin, final, y, distance
) -> _IntegratorState:
    """Choose the first step, and make room for `max_steps` steps."""
    half_way = jnp.where(y[1] > 0, distance / jnp.where(y[1] > 0, 2 * y[1], 1.0), 1.0)
    size, row = jnp.clip(half_way, jnp.finfo(y.dtype).eps, MAX_FIRST_STEP), interval(phase_schedule, begin)
    end = _step_end(phase_schedule, final, begin, size, row)
    no_steps = AcceptedSteps(
        end=jnp.full(options.max_steps, begin),
        row=jnp.zeros(options.max_steps, int),
        y=jnp.broadcast_to(y, (options.max_steps, *y.shape)),
        count=jnp.asarray(0, int),
        passed=jnp.asarray(False),
        complete=jnp.asarray(False),
    )
    solver_state = method.solver.init(method.term, begin, end, y, row)
    _, controller_state = method.controller.init(
        method.term, begin, final, y, size, row, method.solver.func, method.order
    )
    made_jump, attempts = jnp.asarray(False) if options.has_jumps else False, jnp.asarray(0, int)
    return _IntegratorState(begin, end, size, row, y, made_jump, solver_state, controller_state, attempts, no_steps)


def _step_end(phase_schedule: Actuation, final, begin, size, row):
    """Return where a step ends: on the end of its interval of the schedule, rather than beyond or just before it."""
    knot = jnp.minimum(jnp.where(row < phase_schedule.last, take_row(phase_schedule.phase_time, row + 1), final), final)
    return jnp.where(begin + size > knot - 100 * jnp.finfo(size.dtype).eps, knot, begin + size)


def _record(state: _IntegratorState, accepted, y, event: TerminalEvent) -> AcceptedSteps:
    """Append the step that was tried, if it is accepted."""
    steps = state.steps
    place = jnp.where(accepted, steps.count, steps.end.shape[0])
    return steps._replace(
        end=steps.end.at[place].set(state.end, mode="drop"),
        row=steps.row.at[place].set(state.row, mode="drop"),
        y=steps.y.at[place].set(y, mode="drop"),
        count=steps.count + accepted,
        passed=accepted & event.is_past(y),
    )


def _end_rates(solver: dfx.AbstractSolver, field: Callable, state: _IntegratorState, y, dense):
    """Return `dy/du` at both ends of a step times its length; solvers whose last stage is its end know them."""
    if isinstance(tableau := getattr(solver, "tableau", None), dfx.ButcherTableau) and tableau.fsal:
        return dense["k"][0], dense["k"][-1]
    ends = field(state.begin, state.y, state.row), field(state.end, y, state.row)
    return tuple((state.end - state.begin) * rate for rate in ends)
