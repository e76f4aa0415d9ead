"""Plans: trace and simulate a scene's phases one after the other, and say what became of them.

Each phase starts where the wire of the phase before it ended: at rest, or, where that phase arrives `moving`, with the
speed that the impact leaves (`reduction.resolve_impact`), at the moment when the formation changes. It has time until its
planned end.
"""

from dataclasses import replace
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from wholearm_jax.core import (
    BackgroundCall,
    Status,
    as_device_array,
    call_in_background,
    is_transformed,
    require_positive,
    require_x64,
    wait_for,
)
from wholearm_jax.model import (
    Phase,
    Scene,
    TorqueSchedule,
    has_jumps,
    pad_schedule,
    rigid_body,
    round_up,
    scaled_mechanics,
)
from wholearm_jax.phases.assessment import DEFAULT_ARRIVAL, GOALS
from wholearm_jax.phases.phase import (
    SimulatedPhase,
    TracedPhase,
    precompile_simulation,
    simulate_phase,
    target_configuration,
    trace_phase,
    trace_phase_path,
)
from wholearm_jax.phases.result import Result, build_result
from wholearm_jax.simulation import IntegratorOptions, tolerance_as_data, with_step_capacity
from wholearm_jax.tracing import ContactPath, Resolution

TABLE_ROUNDING = 1e4  # of a precision's last digit, the interpolation error that more panels do not make smaller


def trace(scene: Scene, *, resolution: Resolution = Resolution(), tolerance: float = 1e-9) -> tuple[TracedPhase, ...]:
    """Trace and tabulate every phase of a plan.

    The table of a phase is refined (panels doubled, up to 512) until its interpolation error, relative to each
    function's size, is below `tolerance`; pieces are added likewise. What cannot be traced says so in
    `TracedPhase.dynamics.status`, and what follows it cannot be trusted.

    The paper's "set of C-functions equated to zero", solved along the whole wire (derivation, section 3).

    >>> traced = wa.trace(wa.load("heptagon"))
    >>> [wa.Status(int(one.dynamics.status)).label for one in traced]
    ['ok', 'ok']
    >>> print(f"{float(traced[0].dynamics.length):.2f} object radii")
    1.33 object radii
    """
    if is_transformed(scene):  # shapes are fixed there: the caller has chosen the resolution
        return unstack_trees(trace_in_one_program(scene, resolution), len(scene.phases))
    solid, initial_guess, found = rigid_body(scene.object), scene.start, []
    for phase in scene.phases:
        begin = initial_guess, as_device_array(not found)
        traced = _trace_refined(solid, scene, phase, *begin, resolution, tolerance)
        if phase.arrive == "hold" and int(traced.dynamics.status) != Status.OK:
            other = eqx.tree_at(lambda p: p.target.sign, phase, -phase.target.sign)
            traced = _trace_refined(solid, scene, other, *begin, resolution, tolerance)
        found.append(traced)
        initial_guess = target_configuration(phase, traced)
    return tuple(found)


@eqx.filter_jit
def trace_in_one_program(scene: Scene, resolution: Resolution) -> TracedPhase:
    """Every phase of a plan in one program: `TracedPhase` with an axis of phases."""
    solid = rigid_body(scene.object)

    def one(at, phase):
        """Trace a phase from where the one before it ended."""
        (initial_guess, first), (formation, target, holds) = at, phase
        traced = trace_phase(
            solid, scene.hand, scene.gravity, formation, initial_guess, target, resolution, first, holds
        )
        return (jnp.where(holds, traced.begin, traced.end), jnp.asarray(False)), traced

    return jax.lax.scan(one, (scene.start, jnp.asarray(True)), _trace_inputs(scene))[1]


def trace_paths_in_one_program(scene: Scene, resolution: Resolution) -> ContactPath:
    """The wires alone: `ContactPath` with an axis of phases."""
    solid = rigid_body(scene.object)

    def one(at, phase):
        (initial_guess, first), (formation, target, holds) = at, phase
        mechanics = scaled_mechanics(solid, scene.hand, scene.gravity, formation)
        path, begin, end = trace_phase_path(mechanics, initial_guess, target, resolution, first, holds)
        return (jnp.where(holds, begin, end), jnp.asarray(False)), path

    return jax.lax.scan(one, (scene.start, jnp.asarray(True)), _trace_inputs(scene))[1]


def _trace_inputs(scene: Scene):
    """What a plan says of its phases' wires, with an axis of phases: formation, heading, and whether it only holds."""
    return stack_trees([(p.formation, p.target, jnp.asarray(p.arrive == "hold")) for p in scene.phases])


def stack_trees(several):
    """Trees of one kind as one with a leading axis."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *several)


def unstack_trees(together, count: int) -> tuple:
    """The `count` trees that are stacked in one."""
    return tuple(jax.tree.map(lambda leaf, k=k: leaf[k], together) for k in range(count))


def _trace_refined(
    solid, scene, phase: Phase, initial_guess, first, resolution: Resolution, tolerance: float
) -> TracedPhase:
    told, holds = (phase.formation, initial_guess, phase.target), as_device_array(phase.arrive == "hold")
    while True:
        traced = trace_phase(solid, scene.hand, scene.gravity, *told, resolution, first, holds)
        dynamics = traced.dynamics
        least_error = TABLE_ROUNDING * jnp.finfo(dynamics.breakpoints.dtype).eps
        coarse = float(dynamics.error) > max(tolerance, least_error) and int(dynamics.status) == Status.OK
        full = int(dynamics.count) >= resolution.segments
        if full and resolution.segments < 48:
            resolution = resolution._replace(segments=2 * resolution.segments, panels=2 * resolution.panels)
        elif coarse and resolution.panels < 512:
            resolution = resolution._replace(panels=2 * resolution.panels)
        elif coarse or full:
            return eqx.tree_at(lambda t: t.dynamics.status, traced, jnp.asarray(int(Status.NO_CONVERGENCE), int))
        else:
            return traced


def simulate_phases(
    scene: Scene,
    torque: TorqueSchedule,
    traced: tuple[TracedPhase, ...],
    options: IntegratorOptions,
    arrival: float = DEFAULT_ARRIVAL,
) -> tuple[SimulatedPhase, ...]:
    """Simulate every phase; differentiable, and usable under any JAX transformation."""
    alike = len({tuple(leaf.shape for leaf in jax.tree.leaves(one)) for one in traced}) == 1
    if alike and is_transformed(scene, torque, traced):
        phases = stack_trees(
            [(at.dynamics, *phase_inputs(phase)) for at, phase in zip(traced, scene.phases, strict=True)]
        )
        dtype = torque.times.dtype
        options = tolerance_as_data(options, dtype)
        return unstack_trees(
            _simulate_in_one_program(phases, pad_schedule(torque), options, jnp.asarray(arrival, dtype)), len(traced)
        )
    at, found, schedule = initial_carry(torque), [], pad_schedule(torque)
    for phase, one in zip(scene.phases, traced, strict=True):
        at, outcome = scan_step(schedule, options, arrival, at, (one.dynamics, *phase_inputs(phase)))
        found.append(outcome)
    return tuple(found)


@eqx.filter_jit
def _simulate_in_one_program(phases, schedule: TorqueSchedule, options: IntegratorOptions, arrival) -> SimulatedPhase:
    """Every phase of a plan in one program: `SimulatedPhase` with an axis of phases."""
    return jax.lax.scan(partial(scan_step, schedule, options, arrival), initial_carry(schedule), phases)[1]


def initial_carry(torque: TorqueSchedule):
    """When a plan begins, when it should, and at which `z_dot`: what `scan_step` needs of the phases before."""
    zero = as_device_array(0.0, torque.times.dtype)
    return zero, zero, as_device_array(np.zeros(5), zero.dtype)


def phase_inputs(phase: Phase):
    """What a plan says of a phase's motion: its duration, its goal, and whether the next takes over at speed."""
    return phase.duration, as_device_array(GOALS[phase.arrive], int), as_device_array(phase.arrive == "moving")


def scan_step(schedule: TorqueSchedule, options: IntegratorOptions, arrival, at, phase):
    """Simulate the next phase of a plan, from when the one before it ended: one step of a scan."""
    (start, planned, incoming_velocity), (dynamics, duration, goal, passes) = at, phase
    planned, length = _planned_end(planned, duration, start)
    one = simulate_phase(dynamics, schedule, start, length, options, goal, incoming_velocity, arrival)
    return _next_start(planned, passes, one), one


@jax.jit  # outside of other programs, one compiles sooner than its operations one by one
def _planned_end(before, duration, start):
    """When a phase should end, and how long it has."""
    planned = before + duration
    return planned, planned - start


@jax.jit
def _next_start(planned, passes, one: SimulatedPhase):
    """When the next phase begins, when this one should have ended, and at which `z_dot`."""
    ended = one.start + one.duration * one.motion.phase_time[one.motion.count]
    return jnp.where(passes, ended, planned), planned, jnp.where(passes, one.exit_velocity, 0.0)


def margin(
    scene: Scene,
    torque: TorqueSchedule,
    *,
    options: IntegratorOptions = IntegratorOptions(adjoint="both"),
    resolution: Resolution = Resolution(),
) -> Float[Array, ""]:
    """The compressive margin [N] of a plan: the least `c_n` over time and contacts (and, of those that roll, the least
    `mu c_n - |c_t|`), formations assumed to hold.

    Differentiable, in forward and reverse mode, with respect to the torques and every float of the scene; negative
    where a contact would pull; `-inf` where a phase has no motion to score, or its wire is not known. Whether the plan
    succeeds is for `simulate` to say. Phases that hold the object do not count. That the schedule steps is seen where
    its times and the durations are numbers; where they are transformed too, say so: `how=Integration(adjoint="both",
    has_jumps=True)`.

    The forces are those of the paper's section 2.2, its `c_n > 0` (derivation, sections 4 and 7).
    In float32 it has four digits (`docs/accuracy.md`).

    >>> scene = wa.load("heptagon")
    >>> print(f"{float(wa.margin(scene, wa.quasistatic(scene))):.2f} N")
    0.70 N
    """
    options = replace(
        with_plan_step_capacity(options, scene, torque), has_jumps=options.has_jumps or has_torque_jumps(scene, torque)
    )
    return plan_margin(scene, simulate_phases(scene, torque, trace(scene, resolution=resolution), options))


def plan_margin(scene: Scene, found: tuple[SimulatedPhase, ...]) -> Float[Array, ""]:
    """The least margin [N] of simulated phases, those that hold left out; `-inf` where one has no motion to score.

    Raises ValueError for a plan that only holds its object.
    """
    moving = [o.margin_result.margin for o, p in zip(found, scene.phases, strict=True) if p.arrive != "hold"]
    if not moving:
        raise ValueError("a plan that only holds its object has no margin of a motion, see Result.hold_margin")
    return jnp.stack([jnp.where(jnp.isfinite(m), m, -jnp.inf) for m in moving]).min()


def require_motion(scene: Scene) -> None:
    """Raise ValueError for a plan with a phase that holds the object, where only phases that move it make sense."""
    for phase in scene.phases:
        if phase.arrive == "hold":
            raise ValueError(f"phase '{phase.name}' holds the object; this is for phases that move it")


def require_covered(scenes: Scene, torque: TorqueSchedule) -> None:
    """Raise ValueError for a schedule that is shorter than the plan, or than the longest plan of stacked scenes."""
    total = float(np.max(sum(np.asarray(p.duration) for p in scenes.phases)))
    first, last = float(torque.times[0]), float(torque.times[-1])
    if first > 0 or last < total * (1 - 1e-9):
        raise ValueError(f"the torque schedule covers {first:g} to {last:g} s, the plan 0 to {total:g} s")


def simulate(
    scene: Scene,
    torque: TorqueSchedule,
    *,
    tolerance: float = 1e-10,
    max_steps: int = 256,
    traced: tuple[TracedPhase, ...] = (),
    arrival: float = DEFAULT_ARRIVAL,
) -> Result:
    """Simulate a plan under a torque schedule and judge it.

    `tolerance` is the integrator's; `traced` reuses the result of `trace`; `arrival` is how near its wire's end a phase
    must come, as a share of the wire's length. Raises ValueError for a schedule that is shorter than the plan, and for
    a `tolerance`, `max_steps` or `arrival` that is not positive; everything else is a status.

    Integrates the paper's eq. (16) (derivation, section 6). Raises RuntimeError without float64.

    >>> scene = wa.load("heptagon")
    >>> result = wa.simulate(scene, wa.torque_schedule([0.0, 2.0], [[0.0, 0.0], [0.0, 0.0]]))
    >>> result.status.label, result.phases[0].status.label
    ('stuck', 'stuck')
    >>> print(result.message.rpartition(":")[0])
    slide left: stuck, t = 1 s, at rest since 0 s
    """
    require_x64()
    require_positive(tolerance=tolerance, max_steps=max_steps, arrival=arrival)
    require_covered(scene, torque)
    if not traced:
        compiled = precompile_simulate(scene, torque, tolerance, max_steps)
        traced = trace(scene)
        wait_for(compiled)
    while True:
        found = simulate_phases(
            scene, torque, traced, _integrator_options(scene, torque, tolerance, max_steps), arrival
        )
        short = any(int(o.assessment.status) == Status.MAX_STEPS for o in found)
        if not short or max_steps >= 16384:
            return build_result(scene, torque, traced, found)
        max_steps *= 4


def precompile_simulate(
    scene: Scene, torque: TorqueSchedule, tolerance: float = 1e-10, max_steps: int = 256
) -> BackgroundCall:
    """Compile what `simulate` runs in a thread of its own, while wires are traced; it is to be waited for."""
    return call_in_background(
        precompile_simulation, round_up(len(torque.times)), _integrator_options(scene, torque, tolerance, max_steps)
    )


def _integrator_options(scene: Scene, torque: TorqueSchedule, tolerance: float, max_steps: int) -> IntegratorOptions:
    """How `simulate` integrates."""
    stages, steps = max(8, max_steps // 32), has_torque_jumps(scene, torque)
    return with_plan_step_capacity(
        IntegratorOptions(tolerance=tolerance, max_steps=max_steps, max_stages=stages, has_jumps=steps), scene, torque
    )


def with_plan_step_capacity(options: IntegratorOptions, scene: Scene, torque: TorqueSchedule) -> IntegratorOptions:
    """The same integration with room for the steps of a phase under a schedule (`stepping.with_step_capacity`).

    Counted are the rows within a phase, or all where times or durations are being transformed.
    """
    rows = torque.times.shape[0]
    if not is_transformed(torque.times, [phase.duration for phase in scene.phases]):
        ends = np.cumsum([0.0, *(float(phase.duration) for phase in scene.phases)])
        rows = int(np.max(np.diff(np.searchsorted(np.asarray(torque.times), ends))))
    return with_step_capacity(options, rows)


def has_torque_jumps(scenes: Scene, torque: TorqueSchedule) -> bool:
    """Whether a schedule steps within a phase of a scene, or of one of stacked scenes; times and durations that are
    being transformed count as they do not."""
    if is_transformed(torque.times, [phase.duration for phase in scenes.phases]):
        return False
    ends = np.cumsum([np.asarray(phase.duration) for phase in scenes.phases], axis=0)
    first = 0.0
    for before, phase, end in zip([None, *scenes.phases], scenes.phases, ends, strict=False):
        # Who passes on at speed may do so early: then the next phase has what was meant for it.
        if before is None or before.arrive != "moving":
            first = float(np.min(end - np.asarray(phase.duration)))
        if has_jumps(torque, first, float(np.max(end))):
            return True
    return False
