"""The motion of one phase: smooth stages, one after the other, each ended by a segment's end, by rest or by time.

Each stage is a run of steps that ends with the first step past its event. That step is then taken again with the length
that ends on the event, so that the method keeps its order across slip reversals, and events carry their own
derivatives. An object at rest waits before the stage for its departure. Derivation: section 6 of `docs/derivation.md`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float, Int

from wholearm_jax.core import Status, take_row
from wholearm_jax.dynamics import PathDynamics
from wholearm_jax.model import PhaseSchedule, interval
from wholearm_jax.simulation.closed_loop import Actuation, PhaseLoop
from wholearm_jax.simulation.closed_loop_rest import rest_until_departure
from wholearm_jax.simulation.departure import first_departure
from wholearm_jax.simulation.event_step import step_to_event
from wholearm_jax.simulation.integrator import AcceptedSteps, TerminalEvent, integrate_adaptive
from wholearm_jax.simulation.integrator_options import Adjoint, IntegratorOptions
from wholearm_jax.simulation.motion_record import (
    Motion,
    MotionRecord,
    append_rest,
    append_step,
    append_steps,
    empty_record,
    recorded_motion,
)
from wholearm_jax.simulation.path_ode import PathODE, join_state, state_rate
from wholearm_jax.simulation.replay import integrate_with_replay_adjoint, replay_steps


class _MotionState(NamedTuple):
    """State of the loop over stages."""

    phase_time: Float[Array, ""]
    s: Float[Array, ""]
    w: Float[Array, ""]
    segment: Int[Array, ""]
    status: Int[Array, ""]
    done: Bool[Array, ""]
    record: MotionRecord
    memory: Float[Array, "memory"] | None  # of a closed-loop law


def simulate_motion(
    dynamics: PathDynamics,
    phase_schedule: Actuation,
    duration: Float[Array, ""],
    *,
    options: IntegratorOptions,
    s: Float[Array, ""] | None = None,
    speed: Float[Array, ""] | float = 0.0,
    ignore_stops: bool | Bool[Array, ""] = False,
    memory: Float[Array, "memory"] | None = None,
) -> Motion:
    """Simulate the motion of one phase along its path.

    Args:
        dynamics: Tabulated path dynamics.
        phase_schedule: Torque schedule of the phase, or closed-loop law.
        duration: Duration of the phase [s].
        options: Options of the integrator.
        s: Where it begins (None: at the path's start).
        speed: `ds/dt` there [1/s].
        ignore_stops: Let the motion pass rest and the path's end with forward signs of friction: a smooth continuation
            to differentiate, not physics.
        memory: What a closed-loop law remembers there; None in open loop.
    """
    begin = dynamics.breakpoints[0] if s is None else jnp.asarray(s, dynamics.breakpoints.dtype)
    w = jnp.asarray(speed, begin.dtype) * duration
    first = jnp.stack([jnp.zeros((), begin.dtype), begin, w])
    node = first if memory is None else jnp.concatenate([first, memory])
    state = _MotionState(
        phase_time=first[0],
        s=begin,
        w=w,
        segment=jnp.asarray(0, int),
        status=jnp.asarray(int(Status.MAX_STEPS), int),
        done=jnp.asarray(False),
        record=empty_record(options.max_steps, node, phase_schedule.first),
        memory=memory,
    )
    ode, ignore_stops = PathODE(dynamics, phase_schedule, duration), jnp.asarray(ignore_stops)
    state = _run_stages(lambda state: _simulate_stage(ode, options, ignore_stops, state), state, options)
    return recorded_motion(state.record, state.status)


def _run_stages(stage, state: _MotionState, options: IntegratorOptions) -> _MotionState:
    """Simulate stages until the motion is done, at most `max_stages`."""
    if options.adjoint in (Adjoint.NONE, Adjoint.FORWARD):

        def continues(loop):
            count, state = loop
            return ~state.done & (count < options.max_stages)

        start = jnp.asarray(0, int), state
        return jax.lax.while_loop(continues, lambda loop: (loop[0] + 1, stage(loop[1])), start)[1]

    def stage_or_nothing(state, _):  # reverse mode needs a known number
        return jax.lax.cond(state.done, lambda s: s, stage, state), None

    return jax.lax.scan(stage_or_nothing, state, None, length=options.max_stages)[0]


def _simulate_stage(ode: PathODE, options: IntegratorOptions, ignore_stops, state: _MotionState) -> _MotionState:
    """Wait at rest if need be, then move until the segment ends, the object comes to rest, or time is over."""
    dynamics, phase_schedule, _ = ode
    # Wait at rest.
    dwell = _dwell_in_closed_loop if isinstance(phase_schedule, PhaseLoop) else _dwell
    state, rest_status, capacity = dwell(ode, options, ignore_stops, state)
    blocked = rest_status != int(Status.OK)
    # Integrate until the first step past an event.
    is_last = state.segment >= dynamics.count - 1
    s_stop = take_row(dynamics.breakpoints, state.segment + 1) + jnp.where(ignore_stops & is_last, jnp.inf, 0.0)
    w_stop = jnp.where(ignore_stops, -jnp.inf, 0.0)
    final = jnp.where(blocked, state.phase_time, 1.0)
    steps = _integrate(ode, options, state, final, s_stop, w_stop)
    overshot = steps.passed
    last_step = jnp.maximum(steps.count - 1, 0)
    last_time, row = jnp.where(overshot, take_row(steps.end, last_step), 1.0), take_row(steps.row, last_step)
    state, complete = _record_steps(state, steps, overshot, capacity)
    # Take that step again up to the event.
    node = state.phase_time, state.s, state.w, state.memory
    event = step_to_event(ode, options, state.segment, row, node, last_time, s_stop, w_stop, overshot)
    record = append_step(state.record, overshot, (*event[:3], event.memory), state.w, state.segment, row, at_rest=False)
    # Classify the end. An object that has come to rest may start again in the next stage.
    at_path_end, onward = event.at_stop & is_last, event.at_stop & ~is_last
    outcomes = (  # condition, status
        (~complete, int(Status.MAX_STEPS)),
        (blocked, rest_status),
        (event.failed, int(Status.NO_CONVERGENCE)),
        (at_path_end, int(Status.LEFT_FORMATION)),
        (overshot, int(Status.MAX_STEPS)),  # unless another stage follows
    )
    conditions, statuses = zip(*outcomes, strict=True)
    next_segment = jnp.minimum(state.segment + 1, dynamics.speed_ratio.shape[0] - 1)
    return _MotionState(
        phase_time=jnp.where(overshot, event.phase_time, state.phase_time),
        s=jnp.where(overshot, event.s, state.s),
        w=jnp.where(overshot, event.w, state.w) * jnp.where(onward, dynamics.speed_ratio[next_segment], 1.0),
        segment=state.segment + onward,
        status=jnp.select(conditions, statuses, int(Status.OK)),
        done=blocked | ~complete | event.failed | at_path_end | ~overshot,
        record=record,
        memory=_choose(overshot, event.memory, state.memory),
    )


def _choose(is_first, first, second):
    """Choose one of two memories of a law; None in open loop."""
    return None if first is None else jnp.where(is_first, first, second)


def _dwell(ode: PathODE, options, ignore_stops, state: _MotionState):
    """Wait while friction holds an object that is at rest.

    Returns the state after it, the status of the departure, and the number of steps that the record has room for.
    """
    dynamics, phase_schedule, _ = ode
    assert isinstance(phase_schedule, PhaseSchedule)
    is_resting = (state.w <= 0) & ~ignore_stops
    phase_time, rest_status = first_departure(dynamics, phase_schedule, state.segment, state.s, state.phase_time)
    phase_time = jnp.where(is_resting, phase_time, state.phase_time)
    rest_status = jnp.where(is_resting, rest_status, int(Status.OK))
    waits = is_resting & (phase_time > state.phase_time)
    capacity = options.max_steps - state.record.count - waits
    row = interval(phase_schedule, stop_gradient(state.phase_time + phase_time) / 2)
    node = phase_time, state.s, state.w, None
    record = append_step(state.record, waits, node, state.w, state.segment, row, at_rest=True)
    return state._replace(phase_time=phase_time, record=record), rest_status, capacity


def _dwell_in_closed_loop(ode: PathODE, options, ignore_stops, state: _MotionState):
    """Wait as `_dwell` does, while the law goes on."""
    is_resting = (state.w <= 0) & ~ignore_stops
    rest = rest_until_departure(ode, options, state.segment, state.s, state.phase_time, state.memory, is_resting)
    capacity = options.max_steps - state.record.count
    record = append_rest(state.record, rest.steps, state.s, state.segment, jnp.minimum(rest.whole, capacity))
    node, crosses = (rest.phase_time, state.s, state.w, rest.memory), rest.steps.count > rest.whole
    record = append_step(record, crosses, node, state.w, state.segment, rest.row, at_rest=True)
    state = state._replace(phase_time=rest.phase_time, memory=rest.memory, record=record)
    return state, jnp.where(is_resting, rest.status, int(Status.OK)), capacity - rest.steps.count


def _record_steps(
    state: _MotionState, steps: AcceptedSteps, overshot, capacity
) -> tuple[_MotionState, Bool[Array, ""]]:
    """Record all steps but a last one that overshot.

    Returns the state after them, and whether they are complete: the steps of several stages may need more room than
    there is.
    """
    complete = steps.complete & (steps.count <= capacity)
    count = jnp.clip(jnp.where(overshot, steps.count - 1, steps.count), 0, jnp.maximum(capacity, 0))
    record = append_steps(state.record, steps, join_state(state.s, state.w, state.memory), state.segment, count)
    node = take_row(record.nodes, state.record.count + count)
    phase_time, s, w = node[0], node[1], node[2]
    w = jnp.where(count > 0, w, state.w)  # a node at a segment's end holds the speed in the chart before
    memory = None if state.memory is None else node[3:]
    return state._replace(phase_time=phase_time, s=s, w=w, record=record, memory=memory), complete


def _integrate(ode: PathODE, options: IntegratorOptions, state: _MotionState, final, s_stop, w_stop) -> AcceptedSteps:
    """Integrate from the state to `final`, or to the first step past `s_stop` or below the speed `w_stop`."""
    dynamics, phase_schedule, duration = ode
    limits, final = stop_gradient(((s_stop, w_stop), final))
    distance = limits[0] - stop_gradient(state.s)
    tolerance = options.tolerance + 64 * jnp.finfo(state.s.dtype).eps * jnp.abs(stop_gradient(state.s))
    limits = *limits, tolerance
    y = join_state(state.s, state.w, state.memory)
    inputs = (dynamics, duration, state.segment), phase_schedule, state.phase_time, y
    if options.adjoint is Adjoint.REVERSE:
        return integrate_with_replay_adjoint(inputs, _field, _terminal_event, options, final, limits, distance)

    def solve(method, parameters, phase_schedule, begin, y, *more):
        return method(_field(parameters, phase_schedule), phase_schedule, options, begin, final, y, *more)

    if options.adjoint is Adjoint.NONE:
        return solve(integrate_adaptive, *inputs, _terminal_event(limits), distance)
    steps = solve(integrate_adaptive, *stop_gradient(inputs), _terminal_event(limits), distance)
    return solve(replay_steps, *inputs, steps)


def _field(parameters, phase_schedule: Actuation):
    """Return the field of a segment for the integrator."""
    dynamics, duration, segment = parameters
    ode = PathODE(dynamics, phase_schedule, duration)
    return lambda u, y, row: state_rate(ode, segment, row, u, y)


def _terminal_event(limits) -> TerminalEvent:
    """Return the event of a state past `s_stop` or slower than `w_stop`.

    Within a step the object may have come to rest and set out again where one of the Bernstein coefficients of `ds/du`,
    which bound it from below, is negative: those of the quartic with the speeds and accelerations at both ends and the
    distance between them. A way back of less than `tolerance` does not count: the integrator does not resolve it.
    """
    s_stop, w_stop, tolerance = limits

    def is_past(y):
        return (y[0] > s_stop) | (y[1] < w_stop)

    def may_cross_within(y, y_end, rates, width):
        first, last = rates[0][0], rates[1][0]
        second, fourth = first + rates[0][1] * width / 4, last - rates[1][1] * width / 4
        third = 5 * (y_end[0] - y[0]) - first - second - fourth - last
        lowest = jnp.minimum(jnp.minimum(second, third), fourth)
        return jnp.isfinite(w_stop) & (y_end[1] >= w_stop) & (lowest < -tolerance)

    return TerminalEvent(is_past, may_cross_within)
