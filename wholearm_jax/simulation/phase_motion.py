r"""Simulate: one phase as a scalar second-order ODE along its wire, integrated by diffrax's solvers.

Time runs as a share `u` of the phase's duration `T`, and `w = v T` is the speed in `s` per duration, so that steps and
tolerances mean the same for every size and duration:

    ds/du = w,    dw/du = T^2 (A0 + A3 tau1 + A4 tau2) + T A2 w + A1 w^2

with the coefficients of `reduction.PathDynamics`. A phase is a sequence of smooth stages. Each stage is a run of steps
that end on the torque's knots; it stops at the first step that leaves the piece or turns the speed negative.
That step is then taken again with the length that lands exactly on the piece's end, or on rest, so that the method
keeps its order across slip reversals and the landing carries its own derivatives.

At rest, with friction, the object starts forward when the acceleration with forward signs is positive, backward when
the one with backward signs is negative, and stays when neither is; both at once is ambiguous (Painleve).

Derivation: section 6 of `docs/derivation.md`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float, Int

from wholearm_jax.core import Status, fused_matmul, take_row
from wholearm_jax.dynamics import PathDynamics, evaluate, locate_panel
from wholearm_jax.model import PhaseSchedule, interval, torque_at
from wholearm_jax.simulation.event_step import path_acceleration, step_to_event
from wholearm_jax.simulation.integrator import (
    AcceptedSteps,
    IntegratorOptions,
    TerminalEvent,
    integrate_adaptive,
    integrate_with_replay_adjoint,
    replay_steps,
)


class Motion(NamedTuple):
    """The accepted steps of a phase, `count` of them: from node `i` to node `i + 1` in time, `s` and `w`.

    Step `i` lies in piece `segment[i]` and torque interval `row[i]`; `at_rest[i]` marks waiting at rest. `phase_time`
    is time in
    durations. Rows beyond `count` repeat the end. `status` is that of the end alone: `ok` (end of time while moving),
    `left_formation` (the wire's end), `stuck`, `reversed`, `ambiguous`, `no_convergence` (a landing) or `max_steps`.
    """

    phase_time: Float[Array, "nodes"]
    s: Float[Array, "nodes"]
    w: Float[Array, "nodes"]
    w_begin: Float[Array, "steps"]
    segment: Int[Array, "steps"]
    row: Int[Array, "steps"]
    at_rest: Bool[Array, "steps"]
    count: Int[Array, ""]
    status: Int[Array, ""]


class _MotionState(NamedTuple):
    phase_time: Float[Array, ""]
    s: Float[Array, ""]
    w: Float[Array, ""]
    segment: Int[Array, ""]
    count: Int[Array, ""]
    status: Int[Array, ""]
    done: Bool[Array, ""]
    nodes: Float[Array, "nodes 3"]
    w_begin: Float[Array, "steps"]
    segments: Int[Array, "steps"]
    rows: Int[Array, "steps"]
    at_rest: Bool[Array, "steps"]


def simulate_motion(
    dynamics: PathDynamics,
    phase_schedule: PhaseSchedule,
    duration: Float[Array, ""],
    *,
    options: IntegratorOptions,
    s: Float[Array, ""] | None = None,
    speed: Float[Array, ""] | float = 0.0,
    ignore_stops: bool | Bool[Array, ""] = False,
) -> Motion:
    """Move along a wire for one phase, from its start (or `s`) at `speed` [1/s].

    `ignore_stops` lets the motion pass rest and the wire's end with forward signs: a smooth continuation that
    optimisation may
    differentiate, not physics; only an honest run (`free=False`) decides what happens.
    """
    capacity = options.max_steps
    dtype = dynamics.breakpoints.dtype
    begin = dynamics.breakpoints[0] if s is None else jnp.asarray(s, dtype)
    w = jnp.asarray(speed, dtype) * duration
    first = jnp.stack([jnp.zeros((), dtype), begin, w])
    state = _MotionState(
        phase_time=first[0],
        s=begin,
        w=w,
        segment=jnp.asarray(0, int),
        count=jnp.asarray(0, int),
        status=jnp.asarray(int(Status.MAX_STEPS), int),
        done=jnp.asarray(False),
        nodes=jnp.broadcast_to(first, (capacity + 1, 3)),
        w_begin=jnp.zeros(capacity, dtype),
        segments=jnp.zeros(capacity, int),
        rows=jnp.broadcast_to(phase_schedule.first.astype(int), capacity),
        at_rest=jnp.zeros(capacity, bool),
    )
    ignore_stops = jnp.asarray(ignore_stops)

    def stage(state):
        return _stage(dynamics, phase_schedule, duration, options, ignore_stops, state)

    if options.adjoint in ("none", "forward"):
        state = _run_stages(stage, state, options.max_stages)
    else:  # reverse mode must know how often

        def once(state, _):
            return jax.lax.cond(state.done, lambda s: s, stage, state), None

        state, _ = jax.lax.scan(once, state, None, length=options.max_stages)
    beyond = jnp.arange(capacity + 1) > state.count
    nodes = jnp.where(beyond[:, None], state.nodes[state.count], state.nodes)
    return Motion(
        phase_time=nodes[:, 0],
        s=nodes[:, 1],
        w=nodes[:, 2],
        w_begin=state.w_begin,
        segment=state.segments,
        row=state.rows,
        at_rest=state.at_rest,
        count=state.count,
        status=state.status.astype(int),
    )


def _run_stages(stage, state: _MotionState, most: int) -> _MotionState:
    """Stage after stage until all is done, at most so many."""

    def going(loop):
        count, state = loop
        return ~state.done & (count < most)

    return jax.lax.while_loop(going, lambda loop: (loop[0] + 1, stage(loop[1])), (jnp.asarray(0, int), state))[1]


def _stage(dynamics, phase_schedule, duration, options, ignore_stops, state: _MotionState) -> _MotionState:
    """Wait at rest if need be, then move until the piece ends, the object stops, or time is over."""
    state, rest_status, room = _dwell(dynamics, phase_schedule, options, ignore_stops, state)
    blocked = rest_status != int(Status.OK)
    last = state.segment >= dynamics.count - 1
    s_stop = take_row(dynamics.breakpoints, state.segment + 1) + jnp.where(ignore_stops & last, jnp.inf, 0.0)
    w_stop = jnp.where(ignore_stops, -jnp.inf, 0.0)
    final = jnp.where(blocked, state.phase_time, 1.0)

    steps = _integrate(dynamics, phase_schedule, duration, options, state, final, s_stop, w_stop)
    overshot = steps.passed
    last_step = jnp.maximum(steps.count - 1, 0)
    last_time, row = jnp.where(overshot, take_row(steps.end, last_step), 1.0), take_row(steps.row, last_step)
    state, complete = _record_steps(state, steps, overshot, room)
    node = state.phase_time, state.s, state.w
    event = step_to_event(
        dynamics, phase_schedule, duration, options, state.segment, row, node, last_time, s_stop, w_stop, overshot
    )
    land_share, land_s, land_w, passed, failed = event
    state = _append_step(state, overshot, land_share, land_s, land_w, state.w, row, at_rest=False)
    onward = passed & ~last
    factor = dynamics.speed_ratio[jnp.minimum(state.segment + 1, dynamics.speed_ratio.shape[0] - 1)]
    # `done` waits for the next stage where the object has come to rest: it may start again.
    status = jnp.select(
        [~complete, blocked, failed, passed & last, overshot],
        [
            int(Status.MAX_STEPS),
            rest_status,
            *(int(s) for s in (Status.NO_CONVERGENCE, Status.LEFT_FORMATION, Status.MAX_STEPS)),
        ],
        int(Status.OK),
    )
    return state._replace(
        phase_time=jnp.where(overshot, land_share, state.phase_time),
        s=jnp.where(overshot, land_s, state.s),
        w=jnp.where(overshot, land_w, state.w) * jnp.where(onward, factor, 1.0),
        segment=state.segment + onward,
        status=status,
        done=blocked | ~complete | failed | (passed & last) | ~overshot,
    )


def _dwell(dynamics, phase_schedule, options, ignore_stops, state: _MotionState):
    """Wait while friction holds an object that is at rest: the state then, what it does, and room in the record."""
    rest = (state.w <= 0) & ~ignore_stops
    phase_time, rest_status = _first_departure(dynamics, phase_schedule, state)
    phase_time = jnp.where(rest, phase_time, state.phase_time)
    rest_status = jnp.where(rest, rest_status, int(Status.OK))
    waited = rest & (phase_time > state.phase_time)
    room = options.max_steps - state.count - waited
    row = interval(phase_schedule, stop_gradient(state.phase_time + phase_time) / 2)
    state = _append_step(state, waited, phase_time, state.s, state.w, state.w, row, at_rest=True)
    return state._replace(phase_time=phase_time), rest_status, room


def _record_steps(state: _MotionState, steps: AcceptedSteps, overshot, room):
    """Record steps but the last one where it `overshot`: the state after them, whether the record holds them."""
    capacity = state.w_begin.shape[0]
    y0 = jnp.stack([state.s, state.w])
    # The record is as long as one stage may be; several stages together may need more.
    complete = steps.complete & (steps.count <= room)
    rows = jnp.arange(capacity)
    kept = jnp.clip(jnp.where(overshot, steps.count - 1, steps.count), 0, jnp.maximum(room, 0))
    start = state.count
    place = jnp.where(rows < kept, start + 1 + rows, capacity + 1)
    recorded = jnp.concatenate([steps.end[:, None], steps.y], axis=1)
    nodes = state.nodes.at[place].set(recorded, mode="drop")
    entered = jnp.concatenate([y0[1:], steps.y[:-1, 1]])
    phase_time, s, w = take_row(nodes, start + kept)
    state = state._replace(
        phase_time=phase_time,
        s=s,
        w=jnp.where(kept > 0, w, y0[1]),  # a node at a chart's end holds the speed in the chart before
        nodes=nodes,
        w_begin=state.w_begin.at[place - 1].set(entered, mode="drop"),
        segments=state.segments.at[place - 1].set(state.segment, mode="drop"),
        rows=state.rows.at[place - 1].set(steps.row, mode="drop"),
        count=start + kept,
    )
    return state, complete


def _integrate(dynamics, phase_schedule, duration, options, state, final, s_stop, w_stop) -> AcceptedSteps:
    """Steps from the state to `final` or to the first that passes `s_stop` or falls below the speed `w_stop`."""
    limits, final = stop_gradient(((s_stop, w_stop), final))
    way = limits[0] - stop_gradient(state.s)
    least = options.tolerance + 64 * jnp.finfo(state.s.dtype).eps * jnp.abs(stop_gradient(state.s))
    parameters = dynamics, duration, state.segment
    begin, y = state.phase_time, jnp.stack([state.s, state.w])
    if options.adjoint == "reverse":
        return integrate_with_replay_adjoint(
            (parameters, phase_schedule, begin, y), _field, _terminal_event, options, final, (*limits, least), way
        )

    def solve(method, parameters, phase_schedule, begin, y, *more):
        return method(_field(parameters, phase_schedule), phase_schedule, options, begin, final, y, *more)

    inputs = parameters, phase_schedule, begin, y
    fixed = inputs if options.adjoint == "none" else stop_gradient(inputs)
    steps = solve(integrate_adaptive, *fixed, _terminal_event((*limits, least)), way)
    return steps if options.adjoint == "none" else solve(replay_steps, *inputs, steps)


def _field(parameters, phase_schedule: PhaseSchedule):
    """`d(s, w)/du` in a piece, for `stepping`."""
    dynamics, duration, segment = parameters

    def field(u, y, row):
        return jnp.stack([y[1], path_acceleration(dynamics, phase_schedule, duration, segment, row, u, y[0], y[1])])

    return field


def _terminal_event(limits) -> TerminalEvent:
    """A state past the goal or below the floor, a speed; and a step on which the object may have come to rest and set
    out again: one of the coefficients of `ds/du` by Bernstein's polynomials is negative, between which it stays.

    Those of the quartic with the right speeds and accelerations at both ends and the right way between them. Going back
    by the `plan_margin` way, which the tolerance does not see, does not count.
    """
    s_stop, w_stop, least = limits

    def past(y):
        return (y[0] > s_stop) | (y[1] < w_stop)

    def between(y, after, rates, width):
        first, last = rates[0][0], rates[1][0]
        second, fourth = first + rates[0][1] * width / 4, last - rates[1][1] * width / 4
        third = 5 * (after[0] - y[0]) - first - second - fourth - last
        lowest = jnp.minimum(jnp.minimum(second, third), fourth)
        return jnp.isfinite(w_stop) & (after[1] >= w_stop) & (lowest < -least)

    return TerminalEvent(past, between)


def _append_step(state, wanted, phase_time, s, w, w_begin, row, *, at_rest):
    """Add one step to the record where `wanted`."""
    capacity = state.w_begin.shape[0]
    place = jnp.where(wanted & (state.count < capacity), state.count + 1, capacity + 1)
    return state._replace(
        nodes=state.nodes.at[place].set(jnp.stack([phase_time, s, w]), mode="drop"),
        w_begin=state.w_begin.at[place - 1].set(w_begin, mode="drop"),
        segments=state.segments.at[place - 1].set(state.segment, mode="drop"),
        rows=state.rows.at[place - 1].set(row, mode="drop"),
        at_rest=state.at_rest.at[place - 1].set(at_rest, mode="drop"),
        count=state.count + (place <= capacity),
    )


def _first_departure(dynamics, phase_schedule, state):
    """When an object at rest at `s` starts to move, and what it does: `ok`, `reversed`, `ambiguous` or `stuck`.

    The accelerations at rest are linear in the torque, hence piecewise linear in time: their first signs are exact.
    """
    panel, xi = locate_panel(dynamics, state.segment, state.s)
    ahead = evaluate(dynamics.acceleration, panel, xi)[jnp.array([0, 3, 4])]
    behind = -evaluate(dynamics.reverse_acceleration, panel, xi)
    rows = jnp.arange(phase_schedule.slope.shape[0])
    low = jnp.maximum(phase_schedule.phase_time[:-1], state.phase_time)
    high = jnp.minimum(phase_schedule.phase_time[1:], 1.0)
    live = (rows >= phase_schedule.first) & (rows <= phase_schedule.last) & (high >= low)
    # Who starts as an interval ends starts with the next one: no step fits in between.
    inside = high - 8 * jnp.finfo(high.dtype).eps
    tau_low = jax.vmap(torque_at, (None, 0, 0))(phase_schedule, rows, low)

    def first(pull):
        value = pull[0] + fused_matmul(tau_low, pull[1:])
        rate = fused_matmul(phase_schedule.slope, pull[1:])
        root = low - value / jnp.where(rate > 0, rate, 1.0)
        at = jnp.where(value > 0, low, jnp.where((rate > 0) & (root < inside), root, jnp.inf))
        at = jnp.where(live, at, jnp.inf)
        k = jnp.argmin(stop_gradient(at))
        return at[k]

    forward, backward = first(ahead), first(behind)
    both = (forward == backward) & jnp.isfinite(forward)
    rest_status = jnp.select(
        [both, forward < backward, backward < forward],
        [int(Status.AMBIGUOUS), int(Status.OK), int(Status.REVERSED)],
        int(Status.STUCK),
    )
    at = jnp.minimum(forward, backward)
    return jnp.where(jnp.isfinite(at), jnp.where(jnp.isfinite(at), at, 0.0), 1.0), rest_status
