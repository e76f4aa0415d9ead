"""One phase: trace its wire and tabulate it, simulate it, score it and judge it; and where it begins and ends.

Two compiled programs serve every phase of every scene: `prepare` (trace and reduce) and `run` (simulate, score, judge).
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from wholearm_jax.core.arrays import array, digits, given
from wholearm_jax.core.programs import Program
from wholearm_jax.core.status import Status
from wholearm_jax.dynamics.path_dynamics import Change, Table, blank, change, on_panel, powers, reduce_wire
from wholearm_jax.margin.contact_forces import Score, score
from wholearm_jax.margin.statics import Departure, Statics, statics
from wholearm_jax.model.contact_kinematics import GROUPS, PALM_END, ROOT
from wholearm_jax.model.mechanics import System, system
from wholearm_jax.model.scene import Heading, Phase, Scene, contact_name
from wholearm_jax.model.schedule import Torque, evenly, window
from wholearm_jax.phases.assessment import ARRIVAL, GOALS, Verdict, judge
from wholearm_jax.simulation.integrator import Integration, tolerance_as_data
from wholearm_jax.simulation.phase_motion import Motion, move
from wholearm_jax.tracing.path import LEFT, MADE, UNTIL, Resolution, Wire, trace_wire

CONTINUITY = 1e-6  # metres and radians by which a phase may begin beside the end of the one before it
NOWHERE = 1e-9  # length [object radii] of a wire that ends where it begins


class Traced(NamedTuple):
    """A phase's wire and its table, and `z` (SI) where the wire begins and ends."""

    wire: Wire
    table: Table
    begin: Float[Array, "5"]
    end: Float[Array, "5"]


class Outcome(NamedTuple):
    """A simulated phase as arrays: when it begins and how long it may take [s], the change of formation by which it is
    entered, what happens, and `z_dot` (SI) at its end."""

    start: Float[Array, ""]
    duration: Float[Array, ""]
    entered: Change
    motion: Motion
    score: Score
    verdict: Verdict
    leaving: Float[Array, "5"]


@Program
def prepare(
    scene_body, hand, gravity, formation, rough, heading, resolution: Resolution = Resolution(), first=True, holds=True
) -> Traced:
    """Trace a formation's wire from a rough start (SI) and tabulate its reduced dynamics.

    But for the `first` phase of a plan its formation must hold where the phase before it ended, at `rough`; unless it
    only `holds` the object, its wire must not end where it begins. Else the status refuses it.
    """
    mechanics = system(scene_body, hand, gravity, formation)
    wire, begin, end = follow(mechanics, rough, heading, resolution, first, holds)
    return _strong(Traced(wire, reduce_wire(mechanics, wire), begin, end))


def follow(mechanics: System, rough, heading: Heading, resolution: Resolution, first, holds):
    """The wire of `prepare`, and `z` (SI) where it begins and ends; its status refuses one that does not join the phase
    before, or leads nowhere."""
    wire = trace_wire(mechanics, rough, heading, resolution)
    begin, end = (z * mechanics.configuration_unit for z in (wire.start, wire.end))
    apart, known = jnp.abs(begin - rough).max(), wire.status == int(Status.OK)
    open_there = known & ~jnp.asarray(first) & ~(apart < max(CONTINUITY, digits(apart, 5 / 8)))
    nowhere = known & ~jnp.asarray(holds) & (wire.length < NOWHERE)
    refused = [int(Status.NO_CONVERGENCE), int(Status.LEFT_FORMATION)]
    status = jnp.select([open_there, nowhere], refused, wire.status)
    return _strong((eqx.tree_at(lambda w: w.status, wire, status), begin, end))


def _strong(tree):
    """Without weak types, which depend on how a constant was written: they would make a second program of the next."""
    return jax.tree.map(lambda a: jax.lax.convert_element_type(a, a.dtype), tree)


def run(
    table: Table, schedule: Torque, start, duration, how: Integration, goal, arriving=None, arrival=ARRIVAL
) -> Outcome:
    """Simulate one phase from its wire's start, score it and judge whether it ends as `goal` says: a word as in
    `Phase.arrive`, or a number of `GOALS`.

    `arriving` is `z_dot` (SI) at the end of the phase before, for a change of formation while moving (None: at rest);
    `arrival` how near the wire's end the phase must come (`verdict`).
    """
    dtype = table.breaks.dtype
    arriving = np.zeros(5) if arriving is None else arriving
    start, duration, arriving, arrival = (given(a, dtype) for a in (start, duration, arriving, arrival))
    how = tolerance_as_data(how, dtype)
    goal = given(GOALS[goal] if isinstance(goal, str) else goal, int)
    return _run(table, schedule, start, duration, arriving, how, goal, arrival)


@Program
def _run(table: Table, schedule: Torque, start, duration, arriving, how: Integration, goal, arrival) -> Outcome:
    seen = window(schedule, start, duration)
    entered = change(table, arriving)
    motion = move(table, seen, duration, how=how, speed=jnp.maximum(entered.speed, 0.0))
    scored = score(table, seen, duration, motion, how)
    # A wire whose start lies beyond an edge of its formation, be it by rounding, is as good a wire as any beside it.
    beyond = (table.status == int(Status.LEFT_FORMATION)) & (table.length > NOWHERE)
    known = (table.status == int(Status.OK)) | beyond
    whole = known & (motion.status != int(Status.MAX_STEPS))  # of a part nothing is known
    scored = eqx.tree_at(lambda one: one.margin, scored, jnp.where(whole, scored.margin, -jnp.inf))
    verdict = judge(table, motion, scored, goal, entered, arrival)
    last = jnp.maximum(motion.count - 1, 0)
    panel, xi = powers(table, motion.piece[last], motion.s[motion.count])
    leaving = on_panel(table.velocity, panel, xi) * motion.w[motion.count] / duration
    return Outcome(start, duration, entered, motion, scored, verdict, leaving)


def run_blank(rows: int, how: Integration) -> None:
    """Run a phase under a schedule of so many rows, on a table of the usual size that has no wire: that compiles what
    runs those that have one (`programs.beside`)."""
    run(blank(Resolution()), evenly(1.0, np.zeros((rows, 2))), array(0.0), array(1.0), how, "rest")


@jax.jit
def configuration(table: Table, piece: Int[Array, ""], s: Float[Array, ""]) -> Float[Array, "5"]:
    """`z` (SI) at a place of a wire."""
    panel, xi = powers(table, piece, s)
    return on_panel(table.configuration, panel, xi)


@jax.jit
def start_configuration(table: Table) -> Float[Array, "5"]:
    """`z` (SI) where a wire starts."""
    return configuration(table, jnp.asarray(0, int), table.breaks[0])


def final_configuration(table: Table, motion: Motion) -> Float[Array, "5"]:
    """`z` (SI) where a motion has come to."""
    return configuration(table, motion.piece[jnp.maximum(motion.count - 1, 0)], motion.s[motion.count])


def destination(phase: Phase, traced: Traced) -> Float[Array, "5"]:
    """`z` (SI) where a phase should end: at its wire's end, or where it began if it holds the object."""
    return traced.begin if phase.arrive == "hold" else traced.end


def balance_at_start(scene: Scene, phase: Phase, traced: Traced) -> tuple[Statics, Departure]:
    """The statics where a phase begins, and the accelerations with which the object would leave."""
    table = traced.table
    panel, xi = powers(table, jnp.asarray(0, int), table.breaks[0])
    ahead, behind = jax.device_get((on_panel(table.acceleration, panel, xi), on_panel(table.backward, panel, xi)))
    balance = statics(scene, phase.formation, traced.begin)
    return balance, Departure(ahead[[0, 3, 4]], behind)


def ending(traced: Traced, phase: Phase, capacity: int) -> str:
    """Why a phase ends, in words."""
    if phase.arrive == "hold":
        return "the object is held"
    why, index = int(traced.wire.end_why), int(traced.wire.end_contact)
    if why == MADE:
        group, feature = divmod(index, capacity)
        link, kind = GROUPS[group]
        if kind == ROOT:
            return f"e{feature} meets finger{link}'s root"
        if kind == PALM_END:
            return f"e{feature} meets the palm's end at finger{link}"
        return f"{contact_name(link, kind, feature)} is made"
    if why == LEFT:
        return f"{phase.formation.names[phase.formation.contact_of_slot[index]]} leaves its feature"
    return "the phase's own limit is reached" if why == UNTIL else "no end was found"
