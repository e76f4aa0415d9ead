"""One phase: trace its wire and tabulate it, simulate it, score it and judge it; and where it begins and ends.

Two compiled programs serve every phase of every scene: `trace_phase` (trace and reduce) and `run` (simulate, score, judge).
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from wholearm_jax.core.arrays import as_device_array, eps_power, as_strong_array
from wholearm_jax.core.programs import Program
from wholearm_jax.core.status import Status
from wholearm_jax.dynamics.path_dynamics import Impact, PathDynamics, placeholder_dynamics, resolve_impact, evaluate, locate_panel, tabulate_path_dynamics
from wholearm_jax.margin.contact_forces import MarginResult, minimum_margin
from wholearm_jax.margin.statics import RestAccelerations, Statics, contact_statics
from wholearm_jax.model.contact_kinematics import FEATURE_GROUPS, PALM_END, FINGER_ROOT
from wholearm_jax.model.mechanics import ScaledMechanics, scaled_mechanics
from wholearm_jax.model.scene import PathTarget, Phase, Scene, contact_name
from wholearm_jax.model.schedule import TorqueSchedule, uniform_schedule, restrict_to_phase
from wholearm_jax.phases.assessment import DEFAULT_ARRIVAL, GOALS, Assessment, assess_phase
from wholearm_jax.simulation.integrator import IntegratorOptions, tolerance_as_data
from wholearm_jax.simulation.phase_motion import Motion, simulate_motion
from wholearm_jax.tracing.path import LEFT, MADE, UNTIL, Resolution, ContactPath, trace_path

CONTINUITY = 1e-6  # metres and radians by which a phase may begin beside the end of the one before it
NOWHERE = 1e-9  # length [object radii] of a wire that ends where it begins


class TracedPhase(NamedTuple):
    """A phase's wire and its table, and `z` (SI) where the wire begins and ends."""

    wire: ContactPath
    table: PathDynamics
    begin: Float[Array, "5"]
    end: Float[Array, "5"]


class SimulatedPhase(NamedTuple):
    """A simulated phase as arrays: when it begins and how long it may take [s], the change of formation by which it is
    entered, what happens, and `z_dot` (SI) at its end."""

    start: Float[Array, ""]
    duration: Float[Array, ""]
    entered: Impact
    motion: Motion
    score: MarginResult
    verdict: Assessment
    leaving: Float[Array, "5"]


@Program
def trace_phase(
    scene_body, hand, gravity, formation, rough, heading, resolution: Resolution = Resolution(), first=True, holds=True
) -> TracedPhase:
    """Trace a formation's wire from a rough start (SI) and tabulate its reduced dynamics.

    But for the `first` phase of a plan its formation must hold where the phase before it ended, at `rough`; unless it
    only `best_quasistatic_torque_batch` the object, its wire must not end where it begins. Else the status refuses it.
    """
    mechanics = scaled_mechanics(scene_body, hand, gravity, formation)
    wire, begin, end = trace_phase_path(mechanics, rough, heading, resolution, first, holds)
    return strengthen_types(TracedPhase(wire, tabulate_path_dynamics(mechanics, wire), begin, end))


def trace_phase_path(mechanics: ScaledMechanics, rough, heading: PathTarget, resolution: Resolution, first, holds):
    """The wire of `trace_phase`, and `z` (SI) where it begins and ends; its status refuses one that does not join the phase
    before, or leads nowhere."""
    wire = trace_path(mechanics, rough, heading, resolution)
    begin, end = (z * mechanics.configuration_unit for z in (wire.start, wire.end))
    apart, known = jnp.abs(begin - rough).max(), wire.status == int(Status.OK)
    open_there = known & ~jnp.asarray(first) & ~(apart < max(CONTINUITY, eps_power(apart, 5 / 8)))
    nowhere = known & ~jnp.asarray(holds) & (wire.length < NOWHERE)
    refused = [int(Status.NO_CONVERGENCE), int(Status.LEFT_FORMATION)]
    status = jnp.select([open_there, nowhere], refused, wire.status)
    return strengthen_types((eqx.tree_at(lambda w: w.status, wire, status), begin, end))


def strengthen_types(tree):
    """Without weak types, which depend on how a constant was written: they would make a second program of the next."""
    return jax.tree.map(lambda a: jax.lax.convert_element_type(a, a.dtype), tree)


def simulate_phase(
    table: PathDynamics, schedule: TorqueSchedule, start, duration, how: IntegratorOptions, goal, arriving=None, arrival=DEFAULT_ARRIVAL
) -> SimulatedPhase:
    """Simulate one phase from its wire's start, score it and judge whether it ends as `goal` says: a word as in
    `Phase.arrive`, or a number of `GOALS`.

    `arriving` is `z_dot` (SI) at the end of the phase before, for a change of formation while moving (None: at rest);
    `arrival` how near the wire's end the phase must come (`verdict`).
    """
    dtype = table.breaks.dtype
    arriving = np.zeros(5) if arriving is None else arriving
    start, duration, arriving, arrival = (as_strong_array(a, dtype) for a in (start, duration, arriving, arrival))
    how = tolerance_as_data(how, dtype)
    goal = as_strong_array(GOALS[goal] if isinstance(goal, str) else goal, int)
    return _simulate_phase(table, schedule, start, duration, arriving, how, goal, arrival)


@Program
def _simulate_phase(table: PathDynamics, schedule: TorqueSchedule, start, duration, arriving, how: IntegratorOptions, goal, arrival) -> SimulatedPhase:
    seen = restrict_to_phase(schedule, start, duration)
    entered = resolve_impact(table, arriving)
    motion = simulate_motion(table, seen, duration, how=how, speed=jnp.maximum(entered.speed, 0.0))
    scored = minimum_margin(table, seen, duration, motion, how)
    # A wire whose start lies beyond an edge of its formation, be it by rounding, is as good a wire as any beside it.
    beyond = (table.status == int(Status.LEFT_FORMATION)) & (table.length > NOWHERE)
    known = (table.status == int(Status.OK)) | beyond
    whole = known & (motion.status != int(Status.MAX_STEPS))  # of a part nothing is known
    scored = eqx.tree_at(lambda one: one.margin, scored, jnp.where(whole, scored.margin, -jnp.inf))
    verdict = assess_phase(table, motion, scored, goal, entered, arrival)
    last = jnp.maximum(motion.count - 1, 0)
    panel, xi = locate_panel(table, motion.piece[last], motion.s[motion.count])
    leaving = evaluate(table.velocity, panel, xi) * motion.w[motion.count] / duration
    return SimulatedPhase(start, duration, entered, motion, scored, verdict, leaving)


def precompile_simulation(rows: int, how: IntegratorOptions) -> None:
    """Run a phase under a schedule of so many rows, on a table of the usual size that has no wire: that compiles what
    runs those that have one (`programs.call_in_background`)."""
    simulate_phase(placeholder_dynamics(Resolution()), uniform_schedule(1.0, np.zeros((rows, 2))), as_device_array(0.0), as_device_array(1.0), how, "rest")


@jax.jit
def configuration(table: PathDynamics, piece: Int[Array, ""], s: Float[Array, ""]) -> Float[Array, "5"]:
    """`z` (SI) at a place of a wire."""
    panel, xi = locate_panel(table, piece, s)
    return evaluate(table.configuration, panel, xi)


@jax.jit
def start_configuration(table: PathDynamics) -> Float[Array, "5"]:
    """`z` (SI) where a wire starts."""
    return configuration(table, jnp.asarray(0, int), table.breaks[0])


def final_configuration(table: PathDynamics, motion: Motion) -> Float[Array, "5"]:
    """`z` (SI) where a motion has come to."""
    return configuration(table, motion.piece[jnp.maximum(motion.count - 1, 0)], motion.s[motion.count])


def target_configuration(phase: Phase, traced: TracedPhase) -> Float[Array, "5"]:
    """`z` (SI) where a phase should end: at its wire's end, or where it began if it holds the object."""
    return traced.begin if phase.arrive == "hold" else traced.end


def statics_at_start(scene: Scene, phase: Phase, traced: TracedPhase) -> tuple[Statics, RestAccelerations]:
    """The statics where a phase begins, and the accelerations with which the object would leave."""
    table = traced.table
    panel, xi = locate_panel(table, jnp.asarray(0, int), table.breaks[0])
    ahead, behind = jax.device_get((evaluate(table.acceleration, panel, xi), evaluate(table.backward, panel, xi)))
    balance = contact_statics(scene, phase.formation, traced.begin)
    return balance, RestAccelerations(ahead[[0, 3, 4]], behind)


def describe_end(traced: TracedPhase, phase: Phase, capacity: int) -> str:
    """Why a phase ends, in words."""
    if phase.arrive == "hold":
        return "the object is held"
    why, index = int(traced.wire.end_why), int(traced.wire.end_contact)
    if why == MADE:
        group, feature = divmod(index, capacity)
        link, kind = FEATURE_GROUPS[group]
        if kind == FINGER_ROOT:
            return f"e{feature} meets finger{link}'s root"
        if kind == PALM_END:
            return f"e{feature} meets the palm's end at finger{link}"
        return f"{contact_name(link, kind, feature)} is made"
    if why == LEFT:
        return f"{phase.formation.names[phase.formation.contact_of_slot[index]]} leaves its feature"
    return "the phase's own limit is reached" if why == UNTIL else "no end was found"
