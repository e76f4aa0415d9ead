"""Plans: trace and simulate a scene's phases one after the other, and say what became of them.

Each phase starts where the wire of the phase before it ended: at rest, or, where that phase arrives `moving`, with the
speed that the impact leaves (`reduction.change`), at the moment when the formation changes. It has time until its
planned end. Two compiled programs serve every phase of every scene: `prepare` (trace and reduce) and `run` (simulate,
score, judge). Where friction holds the object at rest, `holding` says whether the contacts can, and with which margin.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from wholearm_jax.forces import Score, arcs, force, on_arc, score
from wholearm_jax.holding import Departure, Held, Statics, statics, watch
from wholearm_jax.motion import Integration, Motion, move
from wholearm_jax.programs import Program
from wholearm_jax.reduction import Change, Table, change, horner, powers, reduce_wire
from wholearm_jax.scene import Phase, Scene, body, contact_name
from wholearm_jax.schedule import Torque, has_steps, padded, rounded, window
from wholearm_jax.status import Status
from wholearm_jax.system import system
from wholearm_jax.verdict import ARRIVAL, GOALS, Verdict, judge
from wholearm_jax.wire import LEFT, MADE, UNTIL, Resolution, Wire, trace_wire

SLIPPING = "it should roll, but leaves its friction cone and slips; squeeze it harder, move more slowly, or optimise"
SAMPLED = 1024  # samples of a phase that one call computes: numbers of samples that differ share a program
ROUNDING = 1e4  # of a precision's last digit, the interpolation error that more panels do not make smaller
CONTINUITY = 1e-6  # metres and radians by which a phase may begin beside the end of the one before it


class Traced(NamedTuple):
    """A phase's wire and its table."""

    wire: Wire
    table: Table


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


@dataclass(frozen=True)
class PhaseResult:
    """A simulated phase, readable: times in seconds from the plan's start, contacts by name, forces in newtons.

    `time` is when the phase ended or failed. A phase that is entered while moving begins at `start` with `impulses`
    [N s], one a contact.
    `slips` says that the contact lost is one that should roll, and that it leaves its friction cone.
    `margin` is the least force while the object moves; while friction holds it at rest forces are not determined, and
    `holds` says what the contacts can do. A phase that only holds has the margin of its hold.
    """

    name: str
    arrive: str
    contacts: tuple[str, ...]
    status: Status
    time: float
    contact: str | None
    slips: bool
    start: float
    duration: float
    margin: float
    margin_time: float
    margin_s: float
    margin_contact: str
    impulses: tuple[float, ...]
    holds: tuple[Held, ...]
    traced: Traced
    outcome: Outcome

    @property
    def message(self) -> str:
        """One line: which phase, what, which contact, when."""
        if self.status is Status.OK:
            return f"{self.name}: ok, margin {self.margin:.4g} N at {self.margin_contact}, t = {self.margin_time:.4g} s"
        whose = f" at {self.contact}" if self.contact else ""
        advice = SLIPPING if self.slips else self.status.advice
        return f"{self.name}: {self.status.label}{whose}, t = {self.time:.6g} s: {advice}"


@dataclass(frozen=True)
class Result:
    """A simulated plan. `status` is that of the first phase that is not ok.

    `margin` [N] is the least over its phases, those that only hold left out unless there are no others; `hold_margin`
    is the least of its holds, None without any.
    """

    scene: Scene
    torque: Torque
    phases: tuple[PhaseResult, ...]

    @property
    def status(self) -> Status:
        return next((p.status for p in self.phases if p.status is not Status.OK), Status.OK)

    @property
    def hardest(self) -> PhaseResult:
        """The phase whose margin is the plan's."""
        moving = [p for p in self.phases if p.arrive != "hold"]
        return min(moving or self.phases, key=lambda p: p.margin)

    @property
    def margin(self) -> float:
        return self.hardest.margin

    @property
    def hold_margin(self) -> float | None:
        return min((held.margin for p in self.phases for held in p.holds), default=None)

    @property
    def message(self) -> str:
        """What became of the plan, in one line."""
        failed = (p.message for p in self.phases if p.status is not Status.OK)
        return next(failed, f"ok, margin {self.margin:.4g} N")


@Program
def prepare(scene_body, hand, gravity, formation, rough, heading, resolution: Resolution = Resolution()) -> Traced:
    """Trace a formation's wire from a rough start (SI) and tabulate its reduced dynamics."""
    mechanics = system(scene_body, hand, gravity, formation)
    wire = trace_wire(mechanics, rough, heading, resolution)
    # Weak types, which depend on how a constant was written, would make a second program of the next one.
    return jax.tree.map(lambda a: jax.lax.convert_element_type(a, a.dtype), Traced(wire, reduce_wire(mechanics, wire)))


def run(
    table: Table, schedule: Torque, start, duration, how: Integration, goal, arriving=None, arrival=ARRIVAL
) -> Outcome:
    """Simulate one phase from its wire's start, score it and judge whether it ends as `goal` says: a word as in
    `Phase.arrive`, or a number of `GOALS`.

    `arriving` is `z_dot` (SI) at the end of the phase before, for a change of formation while moving (None: at rest);
    `arrival` how near the wire's end the phase must come (`verdict`).
    """
    dtype = table.breaks.dtype
    arriving = jnp.asarray(np.zeros(5), dtype) if arriving is None else arriving
    start, duration, arrival = (jnp.asarray(a, dtype) for a in (start, duration, arrival))
    goal = jnp.asarray(GOALS[goal] if isinstance(goal, str) else goal)
    return _run(table, schedule, start, duration, arriving, how, goal, arrival)


@Program
def _run(table: Table, schedule: Torque, start, duration, arriving, how: Integration, goal, arrival) -> Outcome:
    seen = window(schedule, start, duration)
    entered = change(table, arriving)
    motion = move(table, seen, duration, how=how, speed=jnp.maximum(entered.speed, 0.0))
    scored = score(table, seen, duration, motion, how)
    verdict = judge(table, motion, scored, goal, entered, arrival)
    last = jnp.maximum(motion.count - 1, 0)
    panel, xi = powers(table, motion.piece[last], motion.s[motion.count])
    leaving = horner(table.velocity[panel], xi) * motion.w[motion.count] / duration
    return Outcome(start, duration, entered, motion, scored, verdict, leaving)


@jax.jit
def configuration(table: Table, piece: Int[Array, ""], s: Float[Array, ""]) -> Float[Array, "5"]:
    """`z` (SI) at a place of a wire."""
    panel, xi = powers(table, piece, s)
    return horner(table.configuration[panel], xi)


@jax.jit
def end_configuration(traced: Traced) -> Float[Array, "5"]:
    """`z` (SI) where a wire ends."""
    return configuration(traced.table, traced.table.count - 1, traced.table.breaks[-1])


@jax.jit
def start_configuration(table: Table) -> Float[Array, "5"]:
    """`z` (SI) where a wire starts."""
    return configuration(table, jnp.asarray(0), table.breaks[0])


def final_configuration(table: Table, motion: Motion) -> Float[Array, "5"]:
    """`z` (SI) where a motion has come to."""
    return configuration(table, motion.piece[jnp.maximum(motion.count - 1, 0)], motion.s[motion.count])


def destination(phase: Phase, traced: Traced) -> Float[Array, "5"]:
    """`z` (SI) where a phase should end: at its wire's end, or where it began if it holds the object."""
    return start_configuration(traced.table) if phase.arrive == "hold" else end_configuration(traced)


def balance_at_start(scene: Scene, phase: Phase, traced: Traced) -> tuple[Statics, Departure]:
    """The statics where a phase begins, and the accelerations with which the object would leave."""
    table = traced.table
    panel, xi = powers(table, jnp.asarray(0), table.breaks[0])
    ahead, behind = jax.device_get((horner(table.acceleration[panel], xi), horner(table.backward[panel], xi)))
    balance = statics(scene, phase.formation, start_configuration(table))
    return balance, Departure(ahead[[0, 3, 4]], behind)


def trace(scene: Scene, *, resolution: Resolution = Resolution(), tolerance: float = 1e-9) -> tuple[Traced, ...]:
    """Trace and tabulate every phase of a plan.

    The table of a phase is refined (panels doubled, up to 512) until its interpolation error, relative to each
    function's size, is below `tolerance`; pieces are added likewise. What cannot be traced says so in
    `Traced.table.status`, and what follows it cannot be trusted.

    The paper's "set of C-functions equated to zero", solved along the whole wire (derivation, section 3).

    >>> traced = wa.trace(wa.load("heptagon"))
    >>> [wa.Status(int(one.table.status)).label for one in traced]
    ['ok', 'ok']
    >>> print(f"{float(traced[0].table.length):.2f} object radii")
    1.33 object radii
    """
    solid, rough, found = body(scene.object), scene.start, []
    for phase in scene.phases:
        traced = _refined(solid, scene, phase, rough, resolution, tolerance)
        if phase.arrive == "hold" and _concrete(traced.table.status) and int(traced.table.status) != Status.OK:
            other = eqx.tree_at(lambda p: p.heading.sign, phase, -phase.heading.sign)
            traced = _refined(solid, scene, other, rough, resolution, tolerance)
        found.append(joined(traced, rough) if found else traced)
        rough = destination(phase, traced)
    return tuple(found)


@jax.jit
def joined(traced: Traced, rough) -> Traced:
    """Refuse a phase whose formation does not hold where the phase before it ended."""
    apart = jnp.abs(start_configuration(traced.table) - rough).max()
    status = traced.table.status
    open_there = (status == 0) & ~(apart < max(CONTINUITY, jnp.finfo(apart.dtype).eps ** (5 / 8)))
    return eqx.tree_at(lambda t: t.table.status, traced, jnp.where(open_there, int(Status.NO_CONVERGENCE), status))


def _concrete(value) -> bool:
    """Whether an array holds numbers now, rather than standing for them in a transformation."""
    try:
        float(value)
    except jax.errors.ConcretizationTypeError:
        return False
    return True


def _refined(solid, scene, phase: Phase, rough, resolution: Resolution, tolerance: float) -> Traced:
    while True:
        traced = prepare(solid, scene.hand, scene.gravity, phase.formation, rough, phase.heading, resolution)
        table = traced.table
        if not _concrete(table.error):
            return traced  # under a transformation shapes are fixed: the caller has chosen the resolution
        least_error = ROUNDING * jnp.finfo(table.breaks.dtype).eps
        coarse = bool(table.error > max(tolerance, least_error)) and int(table.status) == Status.OK
        full = int(table.count) >= resolution.pieces
        if full and resolution.pieces < 48:
            resolution = resolution._replace(pieces=2 * resolution.pieces, panels=2 * resolution.panels)
        elif coarse and resolution.panels < 512:
            resolution = resolution._replace(panels=2 * resolution.panels)
        elif coarse or full:
            return eqx.tree_at(lambda t: t.table.status, traced, jnp.asarray(int(Status.NO_CONVERGENCE)))
        else:
            return traced


def outcomes(
    scene: Scene, torque: Torque, traced: tuple[Traced, ...], how: Integration, arrival: float = ARRIVAL
) -> tuple[Outcome, ...]:
    """Simulate every phase; differentiable, and usable under any JAX transformation."""
    zero = jnp.zeros((), torque.times.dtype)
    schedule, start, planned, still, found = padded(torque), zero, zero, jnp.zeros(5, zero.dtype), []
    arriving = still
    for phase, at in zip(scene.phases, traced, strict=True):
        planned = planned + phase.duration
        one = run(at.table, schedule, start, planned - start, how, phase.arrive, arriving, arrival)
        found.append(one)
        flying = phase.arrive == "moving"
        start = start + one.duration * one.motion.share[one.motion.count] if flying else planned
        arriving = one.leaving if flying else still
    return tuple(found)


def margin(
    scene: Scene,
    torque: Torque,
    *,
    how: Integration = Integration(adjoint="both"),
    resolution: Resolution = Resolution(),
) -> Float[Array, ""]:
    """The compressive margin [N] of a plan: the least `c_n` over time and contacts (and, of those that roll, the least
    `mu c_n - |c_t|`), formations assumed to hold.

    Differentiable, in forward and reverse mode, with respect to the torques and every float of the scene; negative
    where a contact would pull; `-inf` where a phase has no motion to score. Whether the plan succeeds is for
    `simulate` to say. Phases that hold the object do not count. That the schedule steps is seen where its times and the
    durations are numbers; where they are transformed too, say so: `how=Integration(adjoint="both", steps=True)`.

    The forces are those of the paper's section 2.2, its `c_n > 0` (derivation, sections 4 and 7).
    In float32 it has four digits (`docs/accuracy.md`).

    >>> scene = wa.load("heptagon")
    >>> print(f"{float(wa.margin(scene, wa.quasistatic(scene))):.2f} N")
    0.70 N
    """
    how = replace(how, steps=how.steps or steps_within(scene, torque))
    return least(scene, outcomes(scene, torque, trace(scene, resolution=resolution), how))


def least(scene: Scene, found: tuple[Outcome, ...]) -> Float[Array, ""]:
    """The least margin [N] of simulated phases, those that hold left out; `-inf` where one has no motion to score."""
    moving = [o.score.margin for o, p in zip(found, scene.phases, strict=True) if p.arrive != "hold"]
    return jnp.stack([jnp.where(jnp.isfinite(m), m, -jnp.inf) for m in moving]).min()


def require_motion(scene: Scene) -> None:
    """Raise ValueError for a plan with a phase that holds the object, where only phases that move it make sense."""
    for phase in scene.phases:
        if phase.arrive == "hold":
            raise ValueError(f"phase '{phase.name}' holds the object; this is for phases that move it")


def require_covered(scenes: Scene, torque: Torque) -> None:
    """Raise ValueError for a schedule that is shorter than the plan, or than the longest plan of stacked scenes."""
    total = float(np.max(sum(np.asarray(p.duration) for p in scenes.phases)))
    first, last = float(torque.times[0]), float(torque.times[-1])
    if first > 0 or last < total * (1 - 1e-9):
        raise ValueError(f"the torque schedule covers {first:g} to {last:g} s, the plan 0 to {total:g} s")


def simulate(
    scene: Scene,
    torque: Torque,
    *,
    tolerance: float = 1e-10,
    max_steps: int = 256,
    traced: tuple[Traced, ...] = (),
    arrival: float = ARRIVAL,
) -> Result:
    """Simulate a plan under a torque schedule and judge it.

    `tolerance` is the integrator's; `traced` reuses the result of `trace`; `arrival` is how near its wire's end a phase
    must come, as a share of the wire's length. Raises ValueError for a schedule that is shorter than the plan;
    everything else is a status.

    Integrates the paper's eq. (16) (derivation, section 6). Raises RuntimeError without float64.

    >>> scene = wa.load("heptagon")
    >>> result = wa.simulate(scene, wa.torque([0.0, 2.0], [[0.0, 0.0], [0.0, 0.0]]))
    >>> result.status.label, result.phases[0].status.label
    ('stuck', 'stuck')
    >>> print(result.message)
    slide left: stuck, t = 1 s: friction holds the object at rest; raise the torque that pushes it, or lower the squeeze
    """
    require_x64()
    require_covered(scene, torque)
    traced = traced or trace(scene)
    stepped = steps_within(scene, torque)
    while True:
        how = Integration(tolerance=tolerance, max_steps=max_steps, stages=max(8, max_steps // 32), steps=stepped)
        found = outcomes(scene, torque, traced, how, arrival)
        short = any(int(o.verdict.status) == Status.MAX_STEPS for o in found)
        if not short or max_steps >= 16384:
            return describe(scene, torque, traced, found)
        max_steps *= 4


def steps_within(scene: Scene, torque: Torque) -> bool:
    """Whether a schedule steps within a phase; times and durations that are being transformed count as they do not."""
    times = [torque.times, *(phase.duration for phase in scene.phases)]
    if any(isinstance(one, Tracer) for one in times):
        return False
    begins, first = [], 0.0
    for before, (start, _) in zip([None, *scene.phases], _spans(scene), strict=False):
        # Who passes on at speed may do so early: then the next phase has what was meant for it.
        first = first if before is not None and before.arrive == "moving" else start
        begins.append(first)
    return any(has_steps(torque, first, end) for first, (_, end) in zip(begins, _spans(scene), strict=True))


def describe(scene: Scene, torque: Torque, traced, found) -> Result:
    """Arrays as a readable result."""
    rows = []
    for phase, at, outcome in zip(scene.phases, traced, found, strict=True):
        names, start, length = phase.formation.names, float(outcome.start), float(outcome.duration)
        verdict, scored = outcome.verdict, outcome.score
        slot, of_slot = int(verdict.contact), phase.formation.contact_of_slot
        known = bool(np.isfinite(scored.margin)) and int(at.table.status) == Status.OK
        one = PhaseResult(
            name=phase.name,
            arrive=phase.arrive,
            contacts=names,
            status=Status(int(verdict.status)),
            time=start + length * float(verdict.share),
            contact=names[of_slot[slot]] if slot >= 0 else None,
            slips=slot >= 0 and bool(phase.formation.tangential[slot]),
            start=start,
            duration=length,
            margin=float(scored.margin) if known else float("-inf"),
            margin_time=start + length * float(scored.share),
            margin_s=float(scored.s),
            margin_contact=names[of_slot[int(scored.contact)]],
            impulses=tuple(float(outcome.entered.impulse[k]) for k in phase.formation.normal_slots),
            holds=stays(scene, torque, phase, at, outcome),
            traced=at,
            outcome=outcome,
        )
        rows.append(_with_holds(one))
    return Result(scene, torque, tuple(rows))


def stays(scene: Scene, torque: Torque, phase: Phase, traced: Traced, outcome: Outcome) -> tuple[Held, ...]:
    """Every time that friction holds the object at rest in a phase: waiting to start, or stopped on the way."""
    motion = jax.device_get(outcome.motion)
    if int(traced.table.status) != Status.OK:
        return ()
    start, duration = float(outcome.start), float(outcome.duration)
    found = []
    for k in np.flatnonzero(motion.held[: int(motion.count)]):
        z = configuration(traced.table, motion.piece[k], motion.s[k])
        begin, end = (start + duration * float(share) for share in motion.share[k : k + 2])
        found.append(watch(statics(scene, phase.formation, z), torque, begin, end))
    return tuple(found)


def _with_holds(phase: PhaseResult) -> PhaseResult:
    """A phase is lost where the contacts cannot hold the object; one that only holds has its hold's margin."""
    if phase.arrive == "hold" and phase.holds:
        least = min(phase.holds, key=lambda held: held.margin)
        numbers = {"margin": least.margin, "margin_time": least.time, "margin_contact": least.contact}
        phase = replace(phase, **numbers, margin_s=float(phase.traced.table.breaks[0]))
    failed = next((held for held in phase.holds if held.lost is not None), None)
    if failed is None or failed.lost is None or (phase.status is not Status.OK and phase.time < failed.lost):
        return phase
    return replace(phase, status=Status.CONTACT_LOST, time=failed.lost, contact=failed.contact, slips=False)


def _spans(scene: Scene):
    """Start and end time of every phase."""
    ends = np.cumsum([float(p.duration) for p in scene.phases])
    return [(float(end) - float(p.duration), float(end)) for end, p in zip(ends, scene.phases, strict=True)]


def ending(traced: Traced, phase: Phase, capacity: int) -> str:
    """Why a phase ends, in words."""
    if phase.arrive == "hold":
        return "the object is held"
    why, index = int(traced.wire.end_why), int(traced.wire.end_contact)
    if why == MADE:
        group, feature = divmod(index, capacity)
        link, kind = ((0, 0), (1, 0), (2, 0), (1, 1), (2, 1))[group]
        return f"{contact_name(link, kind, feature)} is made"
    if why == LEFT:
        return f"{phase.formation.names[phase.formation.contact_of_slot[index]]} leaves its feature"
    return "the phase's own limit is reached" if why == UNTIL else "no end was found"


class Trajectory(NamedTuple):
    """A phase sampled in time, SI units; `cn` and `ct` are NaN while friction holds the object at rest.

    Their columns are the formation's contacts in order; those it has fewer than four are NaN.
    """

    time: Float[Array, "samples"]
    s: Float[Array, "samples"]
    z: Float[Array, "samples 5"]
    z_dot: Float[Array, "samples 5"]
    torque: Float[Array, "samples 2"]
    cn: Float[Array, "samples contacts"]
    ct: Float[Array, "samples contacts"]


def by_contact(table: Table, piece, forces: Float[Array, "slots"]):
    """`c_n` and `c_t` of every contact from the forces in the constraints; NaN beyond the last contact."""
    rolls = jnp.roll(table.tangential, -1)
    tangential = jnp.where(rolls, jnp.roll(forces, -1), forces * table.tension[piece])
    (slot,) = jnp.nonzero(~table.tangential, size=forces.shape[0], fill_value=-1)
    return tuple(jnp.where(slot >= 0, values[slot], jnp.nan) for values in (forces, tangential))


@Program
def sample(table: Table, schedule: Torque, start, duration, motion: Motion, shares) -> Trajectory:
    """A phase's motion at given shares of its duration; beyond its end the object rests there."""
    seen = window(schedule, start, duration)
    steps = arcs(table, seen, duration, motion)

    def one(share):
        k = jnp.clip((share >= motion.share).sum() - 1, 0, jnp.maximum(motion.count - 1, 0))
        arc = jax.tree.map(lambda a: a[k], steps)
        width = arc.share[1] - arc.share[0]
        xi = jnp.clip((share - arc.share[0]) / jnp.where(width > 0, width, 1.0), 0.0, 1.0)
        _, s, w = on_arc(arc, xi)
        over = share > motion.share[motion.count] + 1e-12
        w = jnp.where(over, 0.0, w)
        panel, at = powers(table, arc.piece, s)
        forces = force(table, seen, duration, arc.piece, arc.row, share, s, w)
        cn, ct = by_contact(table, arc.piece, jnp.where(arc.held | over, jnp.nan, forces))
        tau = seen.values[arc.row] + seen.slope[arc.row] * (share - seen.share[arc.row])
        z_dot = horner(table.velocity[panel], at) * w / duration
        return s, horner(table.configuration[panel], at), z_dot, tau, cn, ct

    return Trajectory(start + duration * shares, *jax.vmap(one)(shares))


def trajectory(result: Result, samples: int = 201) -> tuple[Trajectory, ...]:
    """Every phase at `samples` evenly spaced times; a phase that failed stops there, and later ones are left out.

    A tuple of `Trajectory`, one a phase: `time` `(samples,)` [s], `z` and `z_dot` `(samples, 5)`, `cn` and `ct`
    `(samples, 4)` [N].

    >>> scene = wa.load("heptagon")
    >>> first, *_ = wa.trajectory(wa.simulate(scene, wa.quasistatic(scene)), samples=5)
    >>> [f"{t:.2f}" for t in first.time.tolist()], first.cn.shape
    (['0.00', '0.25', '0.50', '0.75', '1.00'], (5, 4))
    """
    found, schedule, rows = [], padded(result.torque), rounded(samples, SAMPLED)
    for phase in result.phases:
        if int(phase.traced.table.status) != Status.OK:
            break
        left = phase.arrive == "moving" or phase.status is not Status.OK
        stop = (phase.time - phase.start) / phase.duration if left else 1.0
        shares = np.full(rows, stop)
        shares[:samples] = np.linspace(0.0, stop, samples)
        outcome = phase.outcome
        course = sample(phase.traced.table, schedule, outcome.start, outcome.duration, outcome.motion, shares)
        found.append(jax.tree.map(lambda a: a[:samples], jax.device_get(course)))
        if phase.status is not Status.OK:
            break
    return tuple(found)


def require_x64() -> None:
    """Raise unless JAX computes in 64 bits: the statuses' tolerances need them."""
    if jnp.zeros(()).dtype != jnp.float64:
        raise RuntimeError(
            "this function needs float64; call jax.config.update('jax_enable_x64', True) before importing arrays"
        )
