"""Simulation of a plan in closed loop: each phase under its law, from rest or from where the phase before flows on.

The law is that of `docs/feedback.md` in continuous time. It changes the phase where the formation changes: at the
path's end, be it that of another object's path. A phase that ends at a stop is left once the object has stood there;
that the law's push holds it there is what the controller's design sees to.
"""

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from wholearm_jax.core import CachedJit, Status, as_strong_array, is_traced, unstack_trees
from wholearm_jax.dynamics import PathDynamics
from wholearm_jax.model import LawTables, PhaseTables, Scene
from wholearm_jax.phases.assessment import ARRIVAL_SPEED_FACTOR
from wholearm_jax.phases.compressive_margin import plan_margin
from wholearm_jax.phases.phase_simulation import SimulatedPhase, simulate_under
from wholearm_jax.phases.phase_tracing import TracedPhase
from wholearm_jax.phases.plan_simulation import phase_inputs
from wholearm_jax.phases.plan_tracing import refuse_coarse_tables, trace
from wholearm_jax.simulation import (
    Adjoint,
    IntegratorOptions,
    Motion,
    PhaseLoop,
    loop_duration,
    phase_loop,
    place_on_path,
    tolerance_as_data,
)
from wholearm_jax.tracing import ContactPath, PathEnd, Resolution

CLOSED_LOOP_ARRIVAL = 0.01  # distance from the path's end within which a phase must end, in path lengths
LANDING = 2.0  # speed at which an object may meet the stop that ends a phase, over that of the approach
CLOSED_LOOP_TOLERANCE = 1e-7  # of the integrator where objects are many: a law makes errors fade
CLOSED_LOOP_STEPS = 1024  # of a phase: the rows of its reference, twice, and the kinks of its gains
CLOSED_LOOP_STAGES = 12  # smooth stages of a phase: a law may stop the object and start it again


class LoopCarry(NamedTuple):
    """What a phase hands on to the next."""

    start: Float[Array, ""]  # time [s]
    velocity: Float[Array, "5"]  # `z_dot` (SI)
    speed: Float[Array, ""]  # observed speed on the path left behind [rad/s]
    tangent: Float[Array, "2"]  # of the law's curve at its end


def closed_loop_options(options: IntegratorOptions, steps: int = CLOSED_LOOP_STEPS) -> IntegratorOptions:
    """Return the options with room for the steps of a closed loop, whose reference may jump."""
    steps, stages = max(options.max_steps, steps), max(options.max_stages, CLOSED_LOOP_STAGES)
    return replace(options, max_steps=steps, max_stages=stages, has_jumps=True)


def initial_loop_carry(law: LawTables) -> LoopCarry:
    """Return the carry of `loop_step` at a plan's start."""
    zero = jnp.zeros((), law.stiffness.dtype)
    return LoopCarry(zero, jnp.zeros(5, zero.dtype), zero, jnp.zeros(2, zero.dtype))


def loop_step(law: LawTables, options: IntegratorOptions, arrival, carry: LoopCarry, phase):
    """Simulate the next phase of a plan under its law: one step of a scan.

    `phase` is (dynamics, its `phase_loop`, its tables, whether a new contact ends its path, *phase_inputs(phase)).
    """
    dynamics, loop, tables, ends_at_contact, _, goal, is_left_moving = phase
    begin = place_on_path(loop, dynamics, jnp.zeros((), int), dynamics.breakpoints[0])
    duration = loop_duration(law, tables)
    speed = carry.speed * (carry.tangent @ tables.tangent[0])
    memory = jnp.stack([begin, speed, jnp.zeros_like(begin)])

    def is_slow(motion: Motion):
        slow = _ends_slowly(law, tables, loop, dynamics, motion, arrival)
        presses_on = (tables.reach > 0) & ~ends_at_contact & (motion.status == int(Status.LEFT_FORMATION))
        return slow & ~presses_on  # beyond the end of a feature, with nothing in the way

    arrival = as_strong_array(arrival, begin.dtype)
    common = dynamics, loop, carry.start, duration, carry.velocity, options, goal, arrival
    simulated = simulate_under(*common, memory=memory, is_slow=is_slow)
    return _next_carry(law, tables, duration, is_left_moving, simulated), simulated


def _ends_slowly(law, tables: PhaseTables, loop: PhaseLoop, dynamics: PathDynamics, motion: Motion, arrival):
    """Whether a motion ends slowly enough: as in open loop for the reference's duration, or like the approach."""
    duration, last = loop_duration(law, tables), jnp.maximum(motion.count - 1, 0)
    s, v = motion.s[motion.count], motion.w[motion.count] / duration
    _, rate = jax.jvp(lambda s: place_on_path(loop, dynamics, motion.segment[last], s), (s,), (jnp.ones_like(s),))
    max_speed = jnp.sqrt(ARRIVAL_SPEED_FACTOR * arrival) * dynamics.length / tables.time[-1]
    return (v <= max_speed) | ((tables.reach > 0) & (rate * v <= LANDING * tables.approach))


def _next_carry(law: LawTables, tables: PhaseTables, duration, is_left_moving, simulated: SimulatedPhase) -> LoopCarry:
    """Return the carry for the next phase: it begins when this one ends, or after the object has stood at its stop."""
    motion = simulated.motion
    assert motion.memory is not None
    ended = duration * motion.phase_time[motion.count]
    waited = jnp.where(tables.reach > 0, jnp.maximum(ended, tables.time[-1]) + law.settle, tables.time[-1])
    passes = jnp.where(is_left_moving, 1.0, 0.0)
    return LoopCarry(
        simulated.start + jnp.where(is_left_moving, ended, jnp.minimum(waited, duration)),
        passes * simulated.exit_velocity,
        passes * motion.memory[motion.count, 1],
        tables.tangent[-1],  # where the law's curve ends; rows that fill up repeat it
    )


def simulate_closed_loop(
    scene: Scene,
    law: LawTables,
    traced: tuple[TracedPhase, ...],
    options: IntegratorOptions = IntegratorOptions(),
    arrival: float = CLOSED_LOOP_ARRIVAL,
) -> tuple[SimulatedPhase, ...]:
    """Simulate every phase in closed loop; differentiable, and usable under any JAX transformation."""
    require_phases(scene, law)
    carry, found = initial_loop_carry(law), []
    options = tolerance_as_data(closed_loop_options(options), law.stiffness.dtype)
    laws = unstack_trees(law.phases, law.count)
    for path, tables, phase in zip(traced, laws, scene.phases, strict=True):
        one = path.dynamics, tables, ends_at_contact(path.path), *phase_inputs(phase)
        carry, simulated = _simulate_phase(law, options, arrival, carry, one)
        found.append(simulated)
    return tuple(found)


@CachedJit
def _simulate_phase(law: LawTables, options: IntegratorOptions, arrival, carry: LoopCarry, phase):
    """Prepare the law of a phase, and simulate it."""
    dynamics, tables, *inputs = phase
    return loop_step(law, options, arrival, carry, (dynamics, phase_loop(law, tables, dynamics), tables, *inputs))


def ends_at_contact(path: ContactPath) -> Bool[Array, "*lanes"]:
    """Return whether a new contact ends a path."""
    return path.end_reason == int(PathEnd.CONTACT_MADE)


def require_phases(scene: Scene, law: LawTables) -> None:
    """Raise ValueError where a law has another number of phases than a plan."""
    if law.count != len(scene.phases):
        raise ValueError(f"the controller has {law.count} phases, the plan {len(scene.phases)}")


def closed_loop_margin(
    scene: Scene,
    law: LawTables,
    *,
    options: IntegratorOptions = IntegratorOptions(adjoint=Adjoint.BOTH),
    resolution: Resolution = Resolution(),
) -> Float[Array, ""]:
    """Compute the compressive margin [N] of a plan in closed loop, as `margin` does in open loop.

    Differentiable, in forward and reverse mode, with respect to every float of the scene and of the law.

    Args:
        scene: Scene with its plan.
        law: The controller's tables (`feedback.law_tables`).
        options: Integrator options.
        resolution: Sizes of the paths and their tables, to begin with.

    Returns:
        The margin; `-inf` where a phase has no motion or no path.

    Raises:
        ValueError: For a law of another number of phases.
    """
    traced = trace(scene, resolution=resolution)
    value = plan_margin(scene, simulate_closed_loop(scene, law, traced, options))
    return refuse_coarse_tables(value, traced, resolution) if is_traced(scene) else value
