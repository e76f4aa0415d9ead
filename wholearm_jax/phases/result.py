"""Results: what became of a plan and of each of its phases, readable.

Where friction holds the object at rest, `holding` says whether the contacts can, and with which margin.
"""

from dataclasses import dataclass, replace

import jax
import numpy as np

from wholearm_jax.core import Status
from wholearm_jax.margin import RestInterval, contact_statics, rest_margin
from wholearm_jax.model import COORDINATES, Arrival, Phase, Scene, TorqueSchedule
from wholearm_jax.phases.hand_overs import HandOver, find_hand_overs
from wholearm_jax.phases.obstacles import describe_refused_start
from wholearm_jax.phases.phase_ends import configuration, describe_end
from wholearm_jax.phases.phase_simulation import SimulatedPhase
from wholearm_jax.phases.phase_tracing import TracedPhase
from wholearm_jax.phases.standing_fingers import find_standing_defect, hold_during_regrasp
from wholearm_jax.tracing import PathEnd

SLIP_TOL = "it should roll, but leaves its friction cone and slips; squeeze it harder, move more slowly, or optimise"
OPENING_ADVICE = "press it harder there, or enter the phase more slowly"
REFUSED_STARTS = (Status.LEFT_FORMATION, Status.OBSTACLE)  # statuses of a path that mean that it cannot begin
REMEDY_START = "the path cannot begin there: correct the start's pose and angles, or choose other contacts or fingers"
UNTIL_FRACTION = 0.05  # of a path that ends at an obstacle, which the advice leaves out
MIN_REST = 1e-7  # share of a phase: an object that comes to rest at its end does so earlier or later by rounding


@dataclass(frozen=True)
class PhaseResult:
    """A simulated phase, readable: times in seconds from the plan's start, contacts by name, forces in newtons.

    `time` is when the phase ended or failed. A phase that is entered while moving begins at `start` with `impulses`
    [N s], one a contact; where one would have to pull, `opened` is the contact that opens instead, by `opening` [m].
    `detail` names what is in the way where the phase cannot begin, ends at an
    obstacle or cannot be held by any torque, and `remedy` what helps then.
    `slip_velocity` says that the contact lost is one that should roll, and that it leaves its friction cone.
    `margin` is the least force while the object moves; while friction holds it at rest forces are not determined, and
    `best_quasistatic_torque_batch` says what the contacts can do. A phase that only holds has the margin of its hold.
    """

    name: str
    arrive: Arrival
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
    opening: float
    opened: str | None
    holds: tuple[RestInterval, ...]
    traced: TracedPhase
    outcome: SimulatedPhase
    detail: str | None = None
    remedy: str | None = None

    @property
    def message(self) -> str:
        """One line: which phase, what, which contact, when."""
        if self.status is Status.OK:
            least = f"margin {self.margin:.4g} N at {self.margin_contact}, t = {self.margin_time:.4g} s"
            return f"{self.name}: ok, {least}{self._opening_note}"
        whose = f" at {self.contact}" if self.contact else ""
        advice = self.remedy or (SLIP_TOL if self.slips else self.status.advice)
        if self.is_opened_at_its_beginning:
            how_far = f"by {1e6 * self.opening:.2g} micrometres" if np.isfinite(self.opening) else "for good"
            advice = f"the impact at its beginning opens it {how_far}; {self.remedy or OPENING_ADVICE}"
        if self.detail:
            advice = f"{self.detail}; {advice}"
        rests = self.status is Status.STUCK and self.holds
        since = f", at rest since {self.holds[-1].start:.6g} s" if rests else ""
        when = f", t = {self.time:.6g} s" if np.isfinite(self.time) else ""
        return f"{self.name}: {self.status.label}{whose}{when}{since}: {advice}"

    @property
    def is_opened_at_its_beginning(self) -> bool:
        """Whether the phase fails because an impact opens a contact, entered at such a speed."""
        return self.status is Status.CONTACT_LOST and self.opened == self.contact and self.time == self.start

    @property
    def _opening_note(self) -> str:
        """How far and for how long an impact opens a contact that is kept."""
        if not self.opened:
            return ""
        height, duration = 1e6 * self.opening, 1e3 * float(self.outcome.opening.duration)
        return f"; {self.opened} opens at its beginning, by {height:.2g} micrometres for {duration:.2g} ms"


@dataclass(frozen=True)
class Result:
    """A simulated plan. `status` is that of the first phase that is not ok.

    `margin` [N] is the least over its phases, those that only hold left out unless there are no others; `hold_margin`
    is the least of its holds, None without any.
    """

    scene: Scene
    torque: TorqueSchedule
    phases: tuple[PhaseResult, ...]

    @property
    def status(self) -> Status:
        return next((p.status for p in self.phases if p.status is not Status.OK), Status.OK)

    @property
    def critical_phase(self) -> PhaseResult:
        """The phase whose margin is the plan's."""
        moving = [p for p in self.phases if p.arrive is not Arrival.HOLD]
        return min(moving or self.phases, key=lambda p: p.margin)

    @property
    def margin(self) -> float:
        return self.critical_phase.margin

    @property
    def hold_margin(self) -> float | None:
        return min((held.margin for p in self.phases for held in p.holds), default=None)

    @property
    def message(self) -> str:
        """What became of the plan, in one line."""
        failed = (p.message for p in self.phases if p.status is not Status.OK)
        return next(failed, f"ok, margin {self.margin:.4g} N")


def build_result(scene: Scene, torque: TorqueSchedule, traced, found) -> Result:
    """Arrays as a readable result."""
    rows = []
    hand_overs = find_hand_overs(scene, traced)
    for phase, at, outcome, hand_over in zip(scene.phases, traced, found, hand_overs, strict=True):
        names, start, length = phase.formation.names, float(outcome.start), float(outcome.duration)
        assessment, scored = outcome.assessment, outcome.margin_result
        slot, of_slot = int(assessment.contact), phase.formation.contact_of_row
        known = bool(np.isfinite(scored.margin)) and int(at.dynamics.status) == Status.OK
        one = PhaseResult(
            name=phase.name,
            arrive=phase.arrive,
            contacts=names,
            status=Status(int(assessment.status)),
            time=start + length * float(assessment.phase_time),
            contact=names[of_slot[slot]] if slot >= 0 else None,
            slips=slot >= 0 and bool(phase.formation.tangential[slot]),
            start=start,
            duration=length,
            margin=float(scored.margin) if known else float("-inf"),
            margin_time=start + length * float(scored.phase_time),
            margin_s=float(scored.s),
            margin_contact=names[of_slot[int(scored.contact)]],
            opening=(opening := float(outcome.opening.height)),
            opened=names[of_slot[int(outcome.opening.contact)]] if opening > 0 else None,
            impulses=tuple(float(np.asarray(outcome.impact.impulse)[k]) for k in phase.formation.normal_rows),
            holds=_holds(scene, torque, phase, at, outcome, hand_over),
            traced=at,
            outcome=outcome,
            detail=_detail(scene, phase, at, Status(int(assessment.status))),
            remedy=path_remedy(phase, at),
        )
        rows.append(_with_standing_fingers(scene, torque, phase, _with_holds(one)))
    return Result(scene, torque, tuple(rows))


def path_remedy(phase: Phase, traced: TracedPhase) -> str | None:
    """Return what helps where a phase has no path, or one that ends at an obstacle; None where it is all right."""
    status, path = Status(int(traced.dynamics.status)), Status(int(traced.path.status))
    if path in REFUSED_STARTS:
        return REMEDY_START
    if status is Status.MAX_STEPS:
        return "the path goes on beyond the largest number of continuation steps; end the phase with `until`"
    if status is Status.OK and bool(traced.dynamics.ends_at_obstacle):
        begin, end = np.asarray(traced.begin), np.asarray(traced.end)
        units = np.array([np.hypot(*(end - begin)[:2]) + 1e-12] * 2 + [1.0] * 3)
        row = int(np.argmax(np.abs(end - begin) / units))
        value = end[row] - UNTIL_FRACTION * (end - begin)[row]
        before = f"end the phase before with `until = {{{COORDINATES[row]} = {value:.4g}}}`"
        return f"{before}, or change the hand"
    return None


def _detail(scene: Scene, phase: Phase, traced: TracedPhase, status: Status) -> str | None:
    """Name what is in the way of a phase."""
    if int(traced.path.status) in REFUSED_STARTS:
        refused = describe_refused_start(scene, phase, traced.begin)
        ends_at_obstacle = refused and int(traced.path.end_reason) == PathEnd.OBSTACLE
        return f"{refused}; further on {describe_end(scene, phase, traced)}" if ends_at_obstacle else refused
    return describe_end(scene, phase, traced) if status is Status.OBSTACLE else None


def rest_intervals(
    scene: Scene,
    torque: TorqueSchedule,
    phase: Phase,
    traced: TracedPhase,
    outcome: SimulatedPhase,
    hand_over: HandOver | None = None,
    *,
    judge_stability: bool = True,
) -> tuple[RestInterval, ...]:
    """Every time that friction holds the object at rest in a phase: waiting to start, or stopped on the way.

    Where the phase begins with a hand-over, the contacts are those that hold the object less well. `judge_stability`
    says whether to find out what else they may do (`RestInterval.may_move`).
    """
    motion = jax.device_get(outcome.motion)
    if int(traced.dynamics.status) != Status.OK:
        return ()
    start, duration = float(outcome.start), float(outcome.duration)
    found = []
    for k in np.flatnonzero(
        motion.at_rest[: int(motion.count)] & (np.diff(motion.phase_time)[: int(motion.count)] > MIN_REST)
    ):
        z = configuration(traced.dynamics, motion.segment[k], motion.s[k])
        begin, end = (start + duration * float(share) for share in motion.phase_time[k : k + 2])
        balances = [contact_statics(scene, phase.formation, z)]
        if hand_over is not None and k == 0:
            balances.append(hand_over.before.statics)
        rests = [rest_margin(one, torque, begin, end, judge_stability=judge_stability) for one in balances]
        may_move = next((rest.may_move for rest in rests if rest.may_move), ())
        found.append(min(rests, key=lambda rest: rest.margin)._replace(may_move=may_move))
    return tuple(found)


def _holds(
    scene: Scene,
    torque: TorqueSchedule,
    phase: Phase,
    traced: TracedPhase,
    outcome: SimulatedPhase,
    hand_over: HandOver | None,
) -> tuple[RestInterval, ...]:
    """Every time that the object is held at rest: in a regrasp, in which one finger alone moves, all the time."""
    if phase.regrasp is None or int(traced.dynamics.status) != Status.OK:
        return rest_intervals(scene, torque, phase, traced, outcome, hand_over)
    return (hold_during_regrasp(scene, torque, phase, traced, float(outcome.start), float(outcome.duration)),)


def _with_standing_fingers(scene: Scene, torque: TorqueSchedule, phase: Phase, one: PhaseResult) -> PhaseResult:
    """Judge a phase in which a finger is away or moves alone; return any other phase as it is."""
    known = int(one.traced.dynamics.status) == Status.OK
    if not known or not phase.has_free_finger:
        return one
    defect = find_standing_defect(scene, torque, phase, one.traced, one.start, one.duration)
    if defect is None or (one.status is not Status.OK and one.time < defect.time):
        return one
    return replace(one, status=defect.status, time=defect.time, contact=None, slips=False, detail=defect.detail)


def _with_holds(phase: PhaseResult) -> PhaseResult:
    """A phase is lost where the contacts cannot hold the object; one that only holds has its hold's margin."""
    if phase.arrive is Arrival.HOLD and phase.holds:
        least = min(phase.holds, key=lambda held: held.margin)
        numbers = {"margin": least.margin, "margin_time": least.time, "margin_contact": least.contact}
        phase = replace(phase, **numbers, margin_s=float(phase.traced.dynamics.breakpoints[0]))
    failed = next((held for held in phase.holds if held.loss_time is not None), None)
    if failed is None or failed.loss_time is None or (phase.status is not Status.OK and phase.time < failed.loss_time):
        return phase
    return replace(phase, status=Status.CONTACT_LOST, time=failed.loss_time, contact=failed.contact, slips=False)
