"""An object that friction holds at rest in closed loop: the law goes on, until its torque moves the object.

The state at rest is `(u, 0, *memory)`: phase time itself stands where the path's parameter does in motion, so that the
same integrator takes its steps. Its event is that the acceleration with forward signs of friction turns positive, or
the one with backward signs negative.
"""

from typing import NamedTuple

import diffrax as dfx
import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float, Int

from wholearm_jax.core import Status, eps_power, find_bracketed_root, fused_matmul, take_row
from wholearm_jax.dynamics import evaluate, locate_panel
from wholearm_jax.model import interval
from wholearm_jax.simulation.closed_loop import PhaseLoop, memory_rate, torque_of
from wholearm_jax.simulation.integrator import AcceptedSteps, TerminalEvent, integrate_adaptive
from wholearm_jax.simulation.integrator_options import Adjoint, IntegratorOptions, differentiable_solver
from wholearm_jax.simulation.path_ode import PathODE
from wholearm_jax.simulation.replay import integrate_with_replay_adjoint, replay_steps

MAX_ITERATIONS = 40
LAW_ROUNDING = 1e-9  # of the terms of an acceleration, up to which it counts as none: a law's torques are as exact


class Rest(NamedTuple):
    """A rest, and how it ends: `ok` (forward), `reversed`, `ambiguous`, or `stuck` until time is over."""

    phase_time: Float[Array, ""]
    memory: Float[Array, "memory"]
    steps: AcceptedSteps
    whole: Int[Array, ""]  # steps that end before the departure
    row: Int[Array, ""]  # interval of the step in which it comes
    status: Int[Array, ""]


def rest_until_departure(
    ode: PathODE, options: IntegratorOptions, segment, s, phase_time, memory, is_resting: Bool[Array, ""]
) -> Rest:
    """Follow the law while the object rests.

    Args:
        ode: Equation of motion in closed loop.
        options: Options of the integrator.
        segment: Segment of the path.
        s: Where the object rests.
        phase_time: Phase time from which on.
        memory: Memory of the law then.
        is_resting: Whether it rests; else nothing happens.
    """
    dynamics, loop, duration = ode
    assert isinstance(loop, PhaseLoop)
    panel, xi = locate_panel(dynamics, segment, s)
    forward = evaluate(dynamics.acceleration, panel, xi)[jnp.array([0, 3, 4])]
    terms = jnp.stack([forward, -evaluate(dynamics.reverse_acceleration, panel, xi)])
    y = jnp.concatenate([jnp.stack([phase_time, jnp.zeros_like(phase_time)]), memory])
    # Integrate to the first step after which the object moves.
    moves_at_once = starts((loop, terms), y, interval(loop, phase_time)).max() > 0
    final = stop_gradient(jnp.where(is_resting & ~moves_at_once, 1.0, phase_time))
    inputs = (dynamics, duration, segment, s), loop, phase_time, y
    steps = _integrate(inputs, options, final, (loop, terms))
    last = jnp.maximum(steps.count - 1, 0)
    departs, row = steps.passed, jnp.where(steps.count > 0, take_row(steps.row, last), interval(loop, phase_time))
    whole = jnp.where(departs, last, steps.count)
    before = jnp.maximum(whole - 1, 0)
    y = jnp.where(whole > 0, take_row(steps.y, before), y)
    y = y.at[0].set(jnp.where(whole > 0, take_row(steps.end, before), phase_time))
    # Take the step of the departure again, with the length that ends on it.
    length = jnp.where(departs, take_row(steps.end, last) - y[0], 0.0)
    y = _step_to_departure(inputs[0], loop, terms, options, row, y, length)
    # Classify.
    least, most = jnp.sort(starts((loop, terms), y, row))
    after = starts((loop, terms), y, interval(loop, y[0]))
    jumps = (most <= 0) & (after.max() > 0)
    values = jnp.where(jumps | moves_at_once, after, starts((loop, terms), y, row))
    both = jnp.where(jumps | moves_at_once, after.min() > 0, least > 0)
    direction = jnp.where(values[0] >= values[1], int(Status.OK), int(Status.REVERSED))
    stays = jnp.where(steps.complete, int(Status.STUCK), int(Status.MAX_STEPS))
    status = jnp.where(departs | moves_at_once, jnp.where(both, int(Status.AMBIGUOUS), direction), stays)
    return Rest(y[0], y[2:], steps, whole, row, status)


def starts(limits, y, row) -> Float[Array, "2"]:
    """Return the accelerations from rest, forward and backward, beyond rounding: one that is positive moves the object.

    Without friction they are each other's negative, and where a law begins with no acceleration, the sign of rounding
    would say whether the object moves backward.
    """
    loop, terms = limits
    torque = torque_of(loop, row, y[0], y[2:])
    size = jnp.abs(terms[:, 0]) + jnp.abs(terms[:, 1:]) @ jnp.abs(torque)
    return terms[:, 0] + fused_matmul(terms[:, 1:], torque) - LAW_ROUNDING * stop_gradient(size)


def _rate(parameters, loop: PhaseLoop, row, y):
    dynamics, duration, segment, s = parameters
    rate = memory_rate(loop, dynamics, duration, segment, row, y[0], s, y[2:])
    return jnp.concatenate([jnp.stack([jnp.ones_like(y[0]), jnp.zeros_like(y[0])]), rate])


def _field(parameters, loop: PhaseLoop):
    return lambda u, y, row: _rate(parameters, loop, row, y.at[0].set(u))


def _departure(limits) -> TerminalEvent:
    def is_past(y):
        return starts(limits, y, interval(limits[0], y[0])).max() > 0

    return TerminalEvent(is_past, lambda *_: jnp.asarray(False))


def _integrate(inputs, options: IntegratorOptions, final, limits) -> AcceptedSteps:
    """Integrate a rest as `phase_motion` integrates a motion."""
    limits, distance = stop_gradient(limits), jnp.zeros_like(final)
    if options.adjoint is Adjoint.REVERSE:
        return integrate_with_replay_adjoint(inputs, _field, _departure, options, final, limits, distance)
    parameters, loop, begin, y = inputs if options.adjoint is Adjoint.NONE else stop_gradient(inputs)
    event = _departure(limits)
    steps = integrate_adaptive(_field(parameters, loop), loop, options, begin, final, y, event, distance)
    if options.adjoint is Adjoint.NONE:
        return steps
    parameters, loop, begin, y = inputs
    return replay_steps(_field(parameters, loop), loop, options, begin, final, y, steps)


def _step_to_departure(parameters, loop: PhaseLoop, terms, options: IntegratorOptions, row, y, max_length):
    """Take the step that ends where the object starts to move; its derivatives are those of the event."""
    solver = differentiable_solver(options)

    def step(inputs, length):
        parameters, loop, _, y = inputs
        term = dfx.ODETerm(_field(parameters, loop))
        state = solver.init(term, y[0], y[0] + length, y, row)
        return solver.step(term, y[0], y[0] + length, y, row, state, made_jump=True)[0]

    def acceleration(inputs, y):
        """The largest acceleration from rest, its slope along the rest, and the rate of the state."""
        parameters, loop, terms, _ = inputs
        rate = _rate(parameters, loop, row, y)
        value, slope = jax.jvp(lambda y: starts((loop, terms), y, row).max(), (y,), (rate,))
        return value, slope, rate

    # Find the length without derivatives.
    inputs = parameters, loop, terms, y
    fixed, longest = stop_gradient((inputs, max_length))
    tolerance = eps_power(longest, 5 / 8) * longest
    length, _ = find_bracketed_root(
        lambda length: acceleration(fixed, step(fixed, length))[:2],
        longest,
        tolerance=tolerance,
        max_iterations=MAX_ITERATIONS,
    )
    reaches = acceleration(fixed, step(fixed, longest))[0] > 0  # else the torque jumps at the step's end
    y = step(inputs, jnp.where(reaches, length, longest))
    # Correct the state to first order.
    value, slope, rate = acceleration(inputs, y)
    slope, rate = stop_gradient((slope, rate))
    corrects = reaches & (longest > 0) & (slope > 0)
    return y + rate * jnp.where(corrects, -value / jnp.where(corrects, slope, 1.0), 0.0)
