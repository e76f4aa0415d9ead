"""Simulation of a plan: its phases one after the other under a torque schedule.

Each phase starts where the path of the phase before it ended: at rest at the planned time or, where that phase arrives
`moving`, at the moment of the transition, with the speed that the impact leaves (`dynamics.resolve_impact`). It has
time until its planned end.
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from wholearm_jax.core import (
    BackgroundTask,
    as_device_array,
    compile_in_background,
    is_traced,
    on_host,
    require_positive,
    require_x64,
    stack_trees,
    unstack_trees,
    wait_for,
)
from wholearm_jax.model import Arrival, Phase, Scene, TorqueSchedule, pad_schedule, round_up
from wholearm_jax.phases.assessment import DEFAULT_ARRIVAL
from wholearm_jax.phases.phase_simulation import (
    SimulatedPhase,
    precompile_simulation,
    simulate_phase,
    simulate_with_enough_steps,
)
from wholearm_jax.phases.phase_tracing import TracedPhase
from wholearm_jax.phases.plan_schedule import has_torque_jumps, require_covered, with_plan_step_capacity
from wholearm_jax.phases.plan_tracing import trace
from wholearm_jax.phases.result import Result, build_result
from wholearm_jax.simulation import IntegratorOptions, options_with_steps, tolerance_as_data


@on_host("wholearm_jax.margin is the margin as a number that can be transformed")
def simulate(
    scene: Scene,
    torque: TorqueSchedule,
    *,
    tolerance: float = 1e-10,
    max_steps: int = 256,
    traced: tuple[TracedPhase, ...] = (),
    arrival: float = DEFAULT_ARRIVAL,
) -> Result:
    """Simulate a plan under a torque schedule, and assess every phase.

    Integrates the paper's eq. (16) (derivation, section 6).

    Args:
        scene: Scene with its plan.
        torque: Schedule that covers the plan.
        tolerance: Tolerance of the integrator.
        max_steps: Steps a phase to begin with; more are allowed where they do not suffice.
        traced: Result of `trace`, to reuse.
        arrival: Distance from its path's end within which a phase must end, in path lengths.

    Returns:
        The plan's and its phases' status, margin and times. Whatever fails is a status.

    Raises:
        ValueError: For a schedule that is shorter than the plan, and for a `tolerance`, `max_steps` or `arrival` that
            is not positive.
        RuntimeError: Without float64.

    >>> scene = wa.load("heptagon")
    >>> result = wa.simulate(scene, wa.torque_schedule([0.0, 2.0], [[0.0, 0.0], [0.0, 0.0]]))
    >>> result.status.label, result.phases[0].status.label
    ('stuck', 'stuck')
    >>> print(result.message.rpartition(":")[0])
    slide right: stuck, t = 1 s, at rest since 0 s
    """
    require_x64(scene, torque)
    require_positive(tolerance=tolerance, max_steps=max_steps, arrival=arrival)
    require_covered(scene, torque)
    if not traced:
        compiled = precompile_simulate(scene, torque, tolerance, max_steps)
        traced = trace(scene)
        wait_for(compiled)
    options = _integrator_options(scene, torque, tolerance, max_steps)
    simulated = partial(simulate_phases, scene, torque, traced, arrival=arrival)
    return build_result(scene, torque, traced, simulate_with_enough_steps(simulated, options))


def precompile_simulate(
    scene: Scene, torque: TorqueSchedule, tolerance: float = 1e-10, max_steps: int = 256
) -> BackgroundTask:
    """Compile the programs of `simulate` in the background, while paths are traced, and return the task to wait for."""
    options = _integrator_options(scene, torque, tolerance, max_steps)
    return compile_in_background(precompile_simulation, round_up(len(torque.times)), options)


def _integrator_options(scene: Scene, torque: TorqueSchedule, tolerance: float, max_steps: int) -> IntegratorOptions:
    """Return the integrator options of `simulate`."""
    options = options_with_steps(max_steps, tolerance=tolerance, has_jumps=has_torque_jumps(scene, torque))
    return with_plan_step_capacity(options, scene, torque)


def simulate_phases(
    scene: Scene,
    torque: TorqueSchedule,
    traced: tuple[TracedPhase, ...],
    options: IntegratorOptions,
    arrival: float | Float[Array, ""] = DEFAULT_ARRIVAL,
) -> tuple[SimulatedPhase, ...]:
    """Simulate every phase; differentiable, and usable under any JAX transformation."""
    schedule, phases = pad_schedule(torque), list(zip(traced, scene.phases, strict=True))
    same_shapes = len({tuple(leaf.shape for leaf in jax.tree.leaves(one)) for one in traced}) == 1
    if same_shapes and is_traced(scene, torque, traced):
        stacked = stack_trees([(path.dynamics, *phase_inputs(phase)) for path, phase in phases])
        dtype = torque.times.dtype
        options = tolerance_as_data(options, dtype)
        simulated = simulate_in_one_program(stacked, schedule, options, jnp.asarray(arrival, dtype))
        return unstack_trees(simulated, len(traced))
    carry, simulated_phases = initial_carry(torque), []
    for path, phase in phases:
        carry, simulated = scan_step(schedule, options, arrival, carry, (path.dynamics, *phase_inputs(phase)))
        simulated_phases.append(simulated)
    return tuple(simulated_phases)


@eqx.filter_jit
def simulate_in_one_program(phases, schedule: TorqueSchedule, options: IntegratorOptions, arrival) -> SimulatedPhase:
    """Simulate every phase of a plan in one program: a `SimulatedPhase` with a leading axis of phases."""
    return jax.lax.scan(partial(scan_step, schedule, options, arrival), initial_carry(schedule), phases)[1]


def initial_carry(torque: TorqueSchedule):
    """Return the carry of `scan_step` at a plan's start: time [s], planned time [s] and `z_dot` (SI)."""
    zero = as_device_array(0.0, torque.times.dtype)
    return zero, zero, as_device_array(np.zeros(5), zero.dtype)


def phase_inputs(phase: Phase):
    """Return what `scan_step` needs of a phase: duration [s], goal, and whether it is left while moving."""
    return phase.duration, as_device_array(phase.arrive, int), as_device_array(phase.arrive is Arrival.MOVING)


def scan_step(schedule: TorqueSchedule, options: IntegratorOptions, arrival, carry, phase):
    """Simulate the next phase of a plan from the end of the one before: one step of a scan.

    `carry` begins as `initial_carry`; `phase` is (dynamics, *phase_inputs(phase)).
    """
    (start, planned, incoming_velocity), (dynamics, duration, goal, is_left_moving) = carry, phase
    planned, available = _planned_end(planned, duration, start)
    simulated = simulate_phase(dynamics, schedule, start, available, options, goal, incoming_velocity, arrival)
    return _next_start(planned, is_left_moving, simulated), simulated


@jax.jit  # outside of other programs, one compiles sooner than its operations one by one
def _planned_end(planned_start, duration, start):
    """Return the time at which a phase should end, and the duration that is left for it."""
    planned = planned_start + duration
    return planned, planned - start


@jax.jit
def _next_start(planned, is_left_moving, simulated: SimulatedPhase):
    """Return the carry for the next phase: it begins as planned at rest, or when this phase ends, at its velocity."""
    ended = simulated.start + simulated.duration * simulated.motion.phase_time[simulated.motion.count]
    velocity = jnp.where(is_left_moving, simulated.exit_velocity, 0.0)
    return jnp.where(is_left_moving, ended, planned), planned, velocity
