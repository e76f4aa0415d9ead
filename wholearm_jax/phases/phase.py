"""One phase: trace its wire and tabulate it, simulate it, score it and judge it; and where it begins and ends.

Two compiled programs serve every phase of every scene: `trace_phase` (trace and reduce) and `run` (simulate, score, judge).
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from wholearm_jax.core import Program, Status, as_device_array, as_strong_array, eps_power
from wholearm_jax.dynamics import (
    Impact,
    PathDynamics,
    evaluate,
    locate_panel,
    placeholder_dynamics,
    resolve_impact,
    tabulate_path_dynamics,
)
from wholearm_jax.margin import MarginResult, RestAccelerations, Statics, contact_statics, minimum_margin
from wholearm_jax.model import (
    FEATURE_GROUPS,
    FINGER_ROOT,
    PALM_END,
    PathTarget,
    Phase,
    ScaledMechanics,
    Scene,
    TorqueSchedule,
    contact_name,
    restrict_to_phase,
    scaled_mechanics,
    uniform_schedule,
)
from wholearm_jax.phases.assessment import DEFAULT_ARRIVAL, GOALS, Assessment, assess_phase
from wholearm_jax.simulation import IntegratorOptions, Motion, simulate_motion, tolerance_as_data
from wholearm_jax.tracing import LEFT, MADE, UNTIL, ContactPath, Resolution, trace_path

CONTINUITY = 1e-6  # metres and radians by which a phase may begin beside the end of the one before it
NOWHERE = 1e-9  # length [object radii] of a wire that ends where it begins


class TracedPhase(NamedTuple):
    """A phase's wire and its table, and `z` (SI) where the wire begins and ends."""

    path: ContactPath
    dynamics: PathDynamics
    begin: Float[Array, "5"]
    end: Float[Array, "5"]


class SimulatedPhase(NamedTuple):
    """A simulated phase as arrays: when it begins and how long it may take [s], the change of formation by which it is
    entered, what happens, and `z_dot` (SI) at its end."""

    start: Float[Array, ""]
    duration: Float[Array, ""]
    impact: Impact
    motion: Motion
    margin_result: MarginResult
    assessment: Assessment
    exit_velocity: Float[Array, "5"]


@Program
def trace_phase(
    scene_body,
    hand,
    gravity,
    formation,
    initial_guess,
    target,
    resolution: Resolution = Resolution(),
    first=True,
    holds=True,
) -> TracedPhase:
    """Trace a formation's wire from a rough start (SI) and tabulate its reduced dynamics.

    But for the `first` phase of a plan its formation must hold where the phase before it ended, at `initial_guess`; unless it
    only `best_quasistatic_torque_batch` the object, its wire must not end where it begins. Else the status refuses it.
    """
    mechanics = scaled_mechanics(scene_body, hand, gravity, formation)
    path, begin, end = trace_phase_path(mechanics, initial_guess, target, resolution, first, holds)
    return strengthen_types(TracedPhase(path, tabulate_path_dynamics(mechanics, path), begin, end))


def trace_phase_path(
    mechanics: ScaledMechanics, initial_guess, target: PathTarget, resolution: Resolution, first, holds
):
    """The wire of `trace_phase`, and `z` (SI) where it begins and ends; its status refuses one that does not join the phase
    before, or leads nowhere."""
    path = trace_path(mechanics, initial_guess, target, resolution)
    begin, end = (z * mechanics.configuration_unit for z in (path.start, path.end))
    apart, known = jnp.abs(begin - initial_guess).max(), path.status == int(Status.OK)
    open_there = known & ~jnp.asarray(first) & ~(apart < max(CONTINUITY, eps_power(apart, 5 / 8)))
    nowhere = known & ~jnp.asarray(holds) & (path.length < NOWHERE)
    refused = [int(Status.NO_CONVERGENCE), int(Status.LEFT_FORMATION)]
    status = jnp.select([open_there, nowhere], refused, path.status)
    return strengthen_types((eqx.tree_at(lambda w: w.status, path, status), begin, end))


def strengthen_types(tree):
    """Without weak types, which depend on how a constant was written: they would make a second program of the next."""
    return jax.tree.map(lambda a: jax.lax.convert_element_type(a, a.dtype), tree)


def simulate_phase(
    dynamics: PathDynamics,
    schedule: TorqueSchedule,
    start,
    duration,
    options: IntegratorOptions,
    goal,
    incoming_velocity=None,
    arrival=DEFAULT_ARRIVAL,
) -> SimulatedPhase:
    """Simulate one phase from its wire's start, score it and judge whether it ends as `goal` says: a word as in
    `Phase.arrive`, or a number of `GOALS`.

    `incoming_velocity` is `z_dot` (SI) at the end of the phase before, for a change of formation while moving (None: at rest);
    `arrival` how near the wire's end the phase must come (`assessment`).
    """
    dtype = dynamics.breakpoints.dtype
    incoming_velocity = np.zeros(5) if incoming_velocity is None else incoming_velocity
    start, duration, incoming_velocity, arrival = (
        as_strong_array(a, dtype) for a in (start, duration, incoming_velocity, arrival)
    )
    options = tolerance_as_data(options, dtype)
    goal = as_strong_array(GOALS[goal] if isinstance(goal, str) else goal, int)
    return _simulate_phase(dynamics, schedule, start, duration, incoming_velocity, options, goal, arrival)


@Program
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
    phase_schedule = restrict_to_phase(schedule, start, duration)
    entered = resolve_impact(dynamics, incoming_velocity)
    motion = simulate_motion(dynamics, phase_schedule, duration, options=options, speed=jnp.maximum(entered.speed, 0.0))
    scored = minimum_margin(dynamics, phase_schedule, duration, motion, options)
    # A wire whose start lies beyond an edge of its formation, be it by rounding, is as good a wire as any beside it.
    beyond = (dynamics.status == int(Status.LEFT_FORMATION)) & (dynamics.length > NOWHERE)
    known = (dynamics.status == int(Status.OK)) | beyond
    whole = known & (motion.status != int(Status.MAX_STEPS))  # of a part nothing is known
    scored = eqx.tree_at(lambda one: one.margin, scored, jnp.where(whole, scored.margin, -jnp.inf))
    assessment = assess_phase(dynamics, motion, scored, goal, entered, arrival)
    last = jnp.maximum(motion.count - 1, 0)
    panel, xi = locate_panel(dynamics, motion.segment[last], motion.s[motion.count])
    leaving = evaluate(dynamics.velocity, panel, xi) * motion.w[motion.count] / duration
    return SimulatedPhase(start, duration, entered, motion, scored, assessment, leaving)


def precompile_simulation(rows: int, options: IntegratorOptions) -> None:
    """Run a phase under a schedule of so many rows, on a table of the usual size that has no wire: that compiles what
    runs those that have one (`programs.call_in_background`)."""
    simulate_phase(
        placeholder_dynamics(Resolution()),
        uniform_schedule(1.0, np.zeros((rows, 2))),
        as_device_array(0.0),
        as_device_array(1.0),
        options,
        "rest",
    )


@jax.jit
def configuration(dynamics: PathDynamics, segment: Int[Array, ""], s: Float[Array, ""]) -> Float[Array, "5"]:
    """`z` (SI) at a place of a wire."""
    panel, xi = locate_panel(dynamics, segment, s)
    return evaluate(dynamics.configuration, panel, xi)


@jax.jit
def start_configuration(dynamics: PathDynamics) -> Float[Array, "5"]:
    """`z` (SI) where a wire starts."""
    return configuration(dynamics, jnp.asarray(0, int), dynamics.breakpoints[0])


def final_configuration(dynamics: PathDynamics, motion: Motion) -> Float[Array, "5"]:
    """`z` (SI) where a motion has come to."""
    return configuration(dynamics, motion.segment[jnp.maximum(motion.count - 1, 0)], motion.s[motion.count])


def target_configuration(phase: Phase, traced: TracedPhase) -> Float[Array, "5"]:
    """`z` (SI) where a phase should end: at its wire's end, or where it began if it holds the object."""
    return traced.begin if phase.arrive == "hold" else traced.end


def statics_at_start(scene: Scene, phase: Phase, traced: TracedPhase) -> tuple[Statics, RestAccelerations]:
    """The statics where a phase begins, and the accelerations with which the object would leave."""
    dynamics = traced.dynamics
    panel, xi = locate_panel(dynamics, jnp.asarray(0, int), dynamics.breakpoints[0])
    ahead, behind = jax.device_get(
        (evaluate(dynamics.acceleration, panel, xi), evaluate(dynamics.reverse_acceleration, panel, xi))
    )
    balance = contact_statics(scene, phase.formation, traced.begin)
    return balance, RestAccelerations(ahead[[0, 3, 4]], behind)


def describe_end(traced: TracedPhase, phase: Phase, capacity: int) -> str:
    """Why a phase ends, in words."""
    if phase.arrive == "hold":
        return "the object is held"
    why, index = int(traced.path.end_reason), int(traced.path.end_contact)
    if why == MADE:
        group, feature = divmod(index, capacity)
        link, kind = FEATURE_GROUPS[group]
        if kind == FINGER_ROOT:
            return f"e{feature} meets finger{link}'s root"
        if kind == PALM_END:
            return f"e{feature} meets the palm's end at finger{link}"
        return f"{contact_name(link, kind, feature)} is made"
    if why == LEFT:
        return f"{phase.formation.names[phase.formation.contact_of_row[index]]} leaves its feature"
    return "the phase's own limit is reached" if why == UNTIL else "no end was found"
