"""Steps: how a motion is integrated, by one of diffrax's solvers, and the steps that its error chooses.

The loop is the package's own, about diffrax's solver and its controller of errors: every step lies in one interval of
the torque schedule, which is looked up once a step and not at each stage; the next knot is the interval's end; and
nothing else is watched, saved or compiled. By `diffrax.diffeqsolve` a motion compiles to 1.8 times as many operations;
`benchmarks/skipping.py` compares run times.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Literal, NamedTuple

import diffrax as dfx
import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import numpy as np
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float, Int

from wholearm_jax.core import as_strong_array, take_row
from wholearm_jax.model import PhaseSchedule, interval, round_up

LoopKind = Literal["lax", "bounded"]
LOOP_KIND: dict[str, LoopKind] = {"none": "lax", "forward": "lax", "reverse": "bounded", "both": "bounded"}
"""Equinox's loop that serves each adjoint: what is `bounded` passes reverse mode, too."""


class IntegratorOptions(eqx.Module):
    """How to integrate: diffrax solver, error `tolerance` a step (relative, of the wire's scale), limits, adjoint.

    `steps` says that the torque schedule has steps inside the phase. `adjoint` says what the solve will be
    differentiated by: `"none"`, `"forward"`, `"reverse"` (which keeps one state a step and computes each step again on
    its way back) or `"both"` (which keeps every stage). Steps are found by their errors and then differentiated as they
    are: through rejected steps reverse mode gives wrong derivatives (seen with diffrax 0.7.2), and through the choice
    of steps forward mode erratic ones (off by up to 3 % at any tolerance). All but a `tolerance` that is an array is
    static: each choice is a program of its own. The package's own programs get theirs as data.
    """

    solver: dfx.AbstractSolver = eqx.field(static=True, default=dfx.Dopri8())
    tolerance: float | Float[Array | np.ndarray, ""] = 1e-10
    max_steps: int = eqx.field(static=True, default=256)
    max_stages: int = eqx.field(static=True, default=8)
    has_jumps: bool = eqx.field(static=True, default=False)
    adjoint: str = eqx.field(static=True, default="none")


def tolerance_as_data(options: IntegratorOptions, dtype) -> IntegratorOptions:
    """The same integration, with a tolerance that is an array: all tolerances share a program."""
    tolerance = as_strong_array(options.tolerance, dtype)
    return options if tolerance is options.tolerance else replace(options, tolerance=tolerance)


def with_step_capacity(options: IntegratorOptions, rows: int) -> IntegratorOptions:
    """The same integration with room for a step at each of so many rows of a schedule, and for as many more."""
    return replace(options, max_steps=round_up(2 * max(rows, 1), options.max_steps))


class AcceptedSteps(NamedTuple):
    """Accepted steps, `count` of them: when each ends, in which interval of the schedule it lies, the state at its end.

    `passed` says that the last one came past what was to stop it, `complete` that steps did not run out before.
    """

    end: Float[Array, "steps"]
    row: Int[Array, "steps"]
    y: Float[Array, "steps 2"]
    count: Int[Array, ""]
    passed: Bool[Array, ""]
    complete: Bool[Array, ""]


class _IntegratorState(NamedTuple):
    """The next step that `integrate_adaptive` tries; `size` is how long it would be if no knot cut it."""

    begin: Float[Array, ""]
    end: Float[Array, ""]
    size: Float[Array, ""]
    row: Int[Array, ""]
    y: Float[Array, "2"]
    jumped: Bool[Array, ""] | bool
    reused: tuple
    control: tuple
    tries: Int[Array, ""]
    steps: AcceptedSteps


class TerminalEvent(NamedTuple):
    """What ends steps: `past(y)` says that a state is beyond, `between(y, after, rates, width)` that a step may have
    been and come back; `rates` are `dy/du` at its ends times its `width`."""

    past: Callable
    between: Callable


def integrate_adaptive(
    field: Callable,
    phase_schedule: PhaseSchedule,
    options: IntegratorOptions,
    begin,
    final,
    y,
    stop: TerminalEvent,
    way: Float[Array, ""],
) -> AcceptedSteps:
    """Steps by their error from `begin` to `final`, or to the first that comes past its `stop`; each ends at a knot at
    most.

    `field(share, y, row)` is `dy/du` in an interval of the schedule. The first step is a 32nd of the phase, or half of
    `way` at the speed there, if that is shorter. A step that may have been beyond the stop between its ends is taken
    again by halves.
    """
    errors = dfx.PIDController(rtol=options.tolerance, atol=options.tolerance)
    solver, term = _with_stages(options.solver, "lax"), dfx.ODETerm(field)
    order = solver.error_order(term)
    assert order is not None  # that of a stochastic solver may be
    eps = jnp.finfo(y.dtype).eps

    def cut(begin, size, number):
        """Where a step ends: on the interval's end, rather than next to it or beyond."""
        knot = jnp.minimum(
            jnp.where(number < phase_schedule.last, take_row(phase_schedule.phase_time, number + 1), final), final
        )
        return jnp.where(begin + size > knot - 100 * eps, knot, begin + size)

    def attempt(at: _IntegratorState) -> _IntegratorState:
        y, miss, dense, reused, _ = solver.step(term, at.begin, at.end, at.y, at.row, at.reused, at.jumped)
        error = jnp.asarray(miss)
        error = jnp.where(jnp.isnan(error), jnp.inf, error)
        kept, *span, _, control, _ = errors.adapt_step_size(at.begin, at.end, at.y, y, None, error, order, at.control)
        halved = kept & stop.between(at.y, y, _end_rates(solver, field, at, y, dense), at.end - at.begin)
        kept = kept & ~halved
        shorter = at.begin, (at.begin + at.end) / 2, at.control
        begin, end, control = jax.tree.map(lambda a, b: jnp.where(halved, a, b), shorter, (*span, control))
        # What a knot cut short says nothing against the length that was meant.
        size = jnp.where(kept, jnp.maximum(end - begin, at.size), end - begin)
        row = interval(phase_schedule, begin)
        place = jnp.where(kept, at.steps.count, options.max_steps)
        steps = at.steps._replace(
            end=at.steps.end.at[place].set(at.end, mode="drop"),
            row=at.steps.row.at[place].set(at.row, mode="drop"),
            y=at.steps.y.at[place].set(y, mode="drop"),
            count=at.steps.count + kept,
            passed=kept & stop.past(y),
        )
        y, reused = jax.tree.map(lambda new, old: jnp.where(kept, new, old), (y, reused), (at.y, at.reused))
        jumped = jnp.where(kept, row != at.row, at.jumped) if options.has_jumps else False
        return _IntegratorState(
            begin, cut(begin, size, row), size, row, y, jumped, reused, control, at.tries + 1, steps
        )

    def going(at: _IntegratorState):
        return (at.begin < final) & ~at.steps.passed & (at.tries < options.max_steps)

    half = jnp.where(y[1] > 0, way / jnp.where(y[1] > 0, 2 * y[1], 1.0), 1.0)
    size, row = jnp.clip(half, eps, 1 / 32), interval(phase_schedule, begin)
    end = cut(begin, size, row)
    none = AcceptedSteps(
        end=jnp.full(options.max_steps, begin),
        row=jnp.zeros(options.max_steps, int),
        y=jnp.broadcast_to(y, (options.max_steps, 2)),
        count=jnp.asarray(0, int),
        passed=jnp.asarray(False),
        complete=jnp.asarray(False),
    )
    reused = solver.init(term, begin, end, y, row)
    _, control = errors.init(term, begin, final, y, size, row, solver.func, order)
    jumped = jnp.asarray(False) if options.has_jumps else False
    start = _IntegratorState(begin, end, size, row, y, jumped, reused, control, jnp.asarray(0, int), none)
    last = jax.lax.while_loop(going, attempt, start)
    return last.steps._replace(complete=(last.begin >= final) | last.steps.passed)


def _end_rates(solver: dfx.AbstractSolver, field: Callable, at: _IntegratorState, y, dense):
    """`dy/du` at a step's ends times its length, which most solvers know."""
    if isinstance(tableau := getattr(solver, "tableau", None), dfx.ButcherTableau) and tableau.fsal:
        return dense["k"][0], dense["k"][-1]
    ends = field(at.begin, at.y, at.row), field(at.end, y, at.row)
    return tuple((at.end - at.begin) * rate for rate in ends)


def replay_steps(
    field: Callable, phase_schedule: PhaseSchedule, options: IntegratorOptions, begin, final, y, steps: AcceptedSteps
) -> AcceptedSteps:
    """Steps that were `integrate_adaptive`, taken again; those that end on a knot move with it."""
    count, row = steps.count, steps.row
    ends = _step_ends(phase_schedule, steps, final)
    # A batch goes on until its last member has finished: the others take steps of no length.
    ends = jnp.where(jnp.arange(options.max_steps) < count, ends, ends[jnp.maximum(count - 1, 0)])
    ends = jnp.where(count > 0, ends, begin)
    begins = jnp.concatenate([begin[None], ends[:-1]])
    kind = LOOP_KIND[options.adjoint]
    solver, term = _with_stages(options.solver, kind), dfx.ODETerm(field)
    jumps = jnp.append(False, row[1:] != row[:-1])

    def step(at):
        k, y, reused, ys = at
        jumped = take_row(jumps, k) if options.has_jumps else False
        y, _, _, reused, _ = solver.step(
            term, take_row(begins, k), take_row(ends, k), y, take_row(row, k), reused, jumped
        )
        return k + 1, y, reused, ys.at[k].set(y)

    rows = jnp.zeros_like(steps.y)  # not `y`: what a row of a buffer holds before it is written keeps its derivative
    start = jnp.asarray(0, int), y, solver.init(term, begin, ends[0], y, row[0]), rows
    *_, ys = eqxi.while_loop(
        lambda at: at[0] < count, step, start, max_steps=options.max_steps, buffers=lambda at: at[3], kind=kind
    )
    return steps._replace(end=ends, y=ys)


def _step_ends(phase_schedule: PhaseSchedule, steps: AcceptedSteps, final):
    """When steps end: on a knot, or at a time of their own."""
    knot = phase_schedule.phase_time[steps.row + 1]
    return jnp.where((steps.end == stop_gradient(knot)) & (steps.end < final), knot, stop_gradient(steps.end))


@eqx.filter_custom_vjp
def integrate_with_replay_adjoint(
    inputs, field_of: Callable, stop_of: Callable, options: IntegratorOptions, final, limits, way
) -> AcceptedSteps:
    """`integrate_adaptive`, of `field_of(parameters, seen)` until `stop_of(limits)`, whose reverse mode goes back over
    its own
    steps.

    `inputs` are `(parameters, seen, begin, y)`, what it can be differentiated by. Each step is computed once more on
    the way back, from where it began, and none on the way there.
    """
    parameters, phase_schedule, begin, y = inputs
    return integrate_adaptive(
        field_of(parameters, phase_schedule), phase_schedule, options, begin, final, y, stop_of(limits), way
    )


@integrate_with_replay_adjoint.def_fwd
def _replay_forward(_, inputs, *others):
    # Derivatives of a gradient would miss how the states between steps move.
    steps = integrate_with_replay_adjoint(eqxi.nondifferentiable(inputs), *others)
    return steps, steps


@integrate_with_replay_adjoint.def_bwd
def _replay_backward(
    steps: AcceptedSteps, gradient: AcceptedSteps, perturbed, inputs, field_of, stop_of, options, final, limits, way
):
    parameters, phase_schedule, begin, y = inputs
    moved, kept = eqx.partition((parameters, phase_schedule, begin), perturbed[:3])
    solver = solver_of(options)
    ys = jnp.concatenate([y[None], steps.y[:-1]])
    onto_end, onto_y = (
        jnp.zeros_like(value) if slope is None else slope
        for value, slope in zip((steps.end, steps.y), (gradient.end, gradient.y), strict=True)
    )

    def step(moved, y, k):
        parameters, phase_schedule, begin = eqx.combine(moved, kept)
        ends = _step_ends(phase_schedule, steps, final)
        begin = jnp.where(k > 0, take_row(ends, jnp.maximum(k - 1, 0)), begin)
        term, end, row = dfx.ODETerm(field_of(parameters, phase_schedule)), take_row(ends, k), take_row(steps.row, k)
        reused = solver.init(term, begin, end, y, row)
        return end, solver.step(term, begin, end, y, row, reused, made_jump=False)[0]

    def before(at):
        k, onto, total = at
        _, pull = jax.vjp(lambda moved, y: step(moved, y, k), moved, take_row(ys, k))
        phase_time, onto = pull((take_row(onto_end, k), onto + take_row(onto_y, k)))
        return k - 1, onto, jax.tree.map(jnp.add, total, phase_time)

    none = jax.tree.map(jnp.zeros_like, moved)
    start = steps.count - 1, jnp.zeros_like(y), none
    _, onto, total = jax.lax.while_loop(lambda at: at[0] >= 0, before, start)
    return *total, onto


def solver_of(options: IntegratorOptions) -> dfx.AbstractSolver:
    """The solver, with a loop over its stages that may be differentiated as `how` says."""
    return _with_stages(options.solver, LOOP_KIND[options.adjoint])


def _with_stages(solver: dfx.AbstractSolver, kind: LoopKind) -> dfx.AbstractSolver:
    return eqx.tree_at(lambda s: s.scan_kind, solver, kind, is_leaf=lambda x: x is None)
