"""Simulation of one phase: its motion under a torque schedule, the margin of that motion, and its assessment.

One compiled program (`_simulate_phase`) serves every phase of every scene.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from wholearm_jax.core import CachedJit, Status, as_device_array, as_strong_array
from wholearm_jax.dynamics import Impact, PathDynamics, evaluate, locate_panel, placeholder_dynamics, resolve_impact
from wholearm_jax.margin import MarginResult, contact_force, minimum_margin
from wholearm_jax.model import Arrival, TorqueSchedule, restrict_to_phase, uniform_schedule
from wholearm_jax.phases.assessment import DEFAULT_ARRIVAL, Assessment, assess_phase
from wholearm_jax.phases.contact_opening import ContactOpening, contact_opening
from wholearm_jax.phases.phase_tracing import MIN_LENGTH
from wholearm_jax.simulation import Actuation, IntegratorOptions, Motion, simulate_motion, tolerance_as_data
from wholearm_jax.tracing import Resolution

MAX_SIMULATION_STEPS = 16384  # a phase, beyond which nothing is tried again


class SimulatedPhase(NamedTuple):
    """A simulated phase, as arrays."""

    start: Float[Array, ""]  # [s], from the plan's start
    duration: Float[Array, ""]  # [s] available
    impact: Impact  # at which the phase is entered
    opening: ContactOpening  # of a contact at which that would have to pull
    motion: Motion
    margin_result: MarginResult
    assessment: Assessment
    exit_velocity: Float[Array, "5"]  # `z_dot` (SI) at the end of the motion


def simulate_phase(
    dynamics: PathDynamics,
    schedule: TorqueSchedule,
    start,
    duration,
    options: IntegratorOptions,
    goal: Arrival | Int[Array, ""],
    incoming_velocity=None,
    arrival=DEFAULT_ARRIVAL,
) -> SimulatedPhase:
    """Simulate one phase from its path's start, compute its margin, and assess how it ends.

    Args:
        dynamics: Tabulated path dynamics.
        schedule: Torque schedule of the whole plan.
        start: Time at which the phase begins [s].
        duration: Time that it has [s].
        options: Integrator options.
        goal: How the phase must end, an `Arrival`.
        incoming_velocity: `z_dot` (SI) at the end of the phase before, for a transition while moving (None: at rest).
        arrival: Distance from the path's end within which the phase must end, in path lengths.
    """
    dtype = dynamics.breakpoints.dtype
    incoming_velocity = np.zeros(5) if incoming_velocity is None else incoming_velocity
    start, duration, incoming_velocity, arrival = (
        as_strong_array(a, dtype) for a in (start, duration, incoming_velocity, arrival)
    )
    options = tolerance_as_data(options, dtype)
    code = as_strong_array(goal, int)
    return _simulate_phase(dynamics, schedule, start, duration, incoming_velocity, options, code, arrival)


@CachedJit
def _simulate_phase(
    dynamics: PathDynamics,
    schedule: TorqueSchedule,
    start,
    duration,
    incoming_velocity,
    options: IntegratorOptions,
    goal,
    arrival,
) -> SimulatedPhase:
    """Simulate, score and assess one phase; see `simulate_phase`."""
    phase_schedule = restrict_to_phase(schedule, start, duration)
    return simulate_under(dynamics, phase_schedule, start, duration, incoming_velocity, options, goal, arrival)


def simulate_under(
    dynamics: PathDynamics,
    actuation: Actuation,
    start,
    duration,
    incoming_velocity,
    options: IntegratorOptions,
    goal,
    arrival,
    memory=None,
    is_slow=None,
) -> SimulatedPhase:
    """Simulate, score and assess one phase under a schedule or, with its `memory`, a closed-loop law.

    `is_slow(motion)` says whether a motion ends slowly enough for a rest (None: `assess_phase` decides).
    """
    # Enter the phase and integrate its motion.
    impact = resolve_impact(dynamics, incoming_velocity)
    speed = jnp.maximum(impact.speed, 0.0)
    motion = simulate_motion(dynamics, actuation, duration, options=options, speed=speed, memory=memory)
    # Compute the margin: unknown for part of a motion, and without a path. A path whose start lies beyond an edge of
    # its formation, be it by rounding, is as good as any beside it.
    margin_result = minimum_margin(dynamics, actuation, duration, motion, options)
    starts_beyond = (dynamics.status == int(Status.LEFT_FORMATION)) & (dynamics.length > MIN_LENGTH)
    has_path = (dynamics.status == int(Status.OK)) | starts_beyond
    is_known = has_path & (motion.status != int(Status.MAX_STEPS))
    margin = jnp.where(is_known, margin_result.margin, -jnp.inf)
    margin_result = eqx.tree_at(lambda r: r.margin, margin_result, margin)
    # Assess the end, and evaluate the velocity there.
    slow = None if is_slow is None else is_slow(motion)
    first = motion.segment[0], motion.row[0], motion.phase_time[0], motion.s[0], motion.w_begin[0]
    remembered = None if motion.memory is None else motion.memory[0]
    opening = contact_opening(dynamics, impact, contact_force(dynamics, actuation, duration, *first, remembered))
    assessment = assess_phase(dynamics, motion, margin_result, goal, impact, opening, arrival, slow)
    last = jnp.maximum(motion.count - 1, 0)
    panel, xi = locate_panel(dynamics, motion.segment[last], motion.s[motion.count])
    exit_velocity = evaluate(dynamics.velocity, panel, xi) * motion.w[motion.count] / duration
    return SimulatedPhase(start, duration, impact, opening, motion, margin_result, assessment, exit_velocity)


def simulate_with_enough_steps(
    simulated: Callable[[IntegratorOptions], Sequence[SimulatedPhase]], options: IntegratorOptions
) -> Sequence[SimulatedPhase]:
    """Simulate phases with four times as many steps, again and again, where those of the options do not suffice.

    They are few for most motions; joints of much viscous friction, or torques that change fast, need more.
    """
    while True:
        phases = simulated(options)
        used_up = any(int(phase.assessment.status) == Status.MAX_STEPS for phase in phases)
        if not used_up or options.max_steps >= MAX_SIMULATION_STEPS:
            return phases
        options = replace(options, max_steps=4 * options.max_steps, max_stages=4 * options.max_stages)


def precompile_simulation(rows: int, options: IntegratorOptions) -> None:
    """Compile `simulate_phase` for schedules of `rows` rows, by a call on a placeholder of the usual size."""
    simulate_phase(
        placeholder_dynamics(Resolution()),
        uniform_schedule(1.0, np.zeros((rows, 2))),
        as_device_array(0.0),
        as_device_array(1.0),
        options,
        Arrival.AT_REST,
    )
