"""Does the prediction hold? Hundreds of random plans, predicted by the model and executed by free bodies in MuJoCo.

    python benchmarks/prediction.py [--pausing 30] [--stopping 10] [--flying 20] [--seeds 0 1] [--quick]

Plans of two phases (`random_plans`) get optimised and quasi-static torques in turn. Half way they hold the object for
`PAUSE`, or, to see what that is worth, stop and go on at once. Plans of three phases that do not stop (`flying_plans`)
get optimised torques. These are then spoiled. A *squeeze* adds torques along the one direction that leaves the motion
as it is, as many as move the predicted least force to a place drawn evenly on both sides of zero. A *push* adds torques
along the other direction, so that the object falls short. Variants are drawn until a plan has two that are predicted to
hold and two to fail, or the draws are used up. Left out is one that is predicted to reach a path's end early, and at
speed: its plan says nothing about the impact that follows; and one in which a phase that others follow ends more than
`PASSED` short of its path, but within the tolerance: the next formation's contacts are open there.

What counts, by the same tolerances on both sides:

- *predicted to hold*: no contact force is tensile for `FREE` running while its phase lasts (`MARGIN_OF_TIME` at either
  end left out), no impact opens a contact by more than a micrometre, no hold is infeasible, and every phase ends within
  `TOLERANCE` (0.5 mm, 0.01 rad) of its path's end;
- *executed to hold*: `execution.execute` at 0.05 ms ends `ok` (within the same tolerance, the last contacts closed to
  0.5 mm), where a phase should end at rest the object is within the tolerance, and no contact of a formation was open
  for `FREE` running, its phase's ends left out alike. Open is a gap of more than `OPEN`: where forces settle anew, as
  when torques step at rest, soft contacts come off by less. Thresholds of 1 to 20 micrometres decide alike.
Forces of an object at rest are not determined, as friction may take any part of them: those of an object that is held,
or slower than `SLOW` of its phase's mean speed, are judged on neither side.

A prediction is *clear* where its least force is farther from zero than `CLEAR` of the mean force; that its end is
farther from the tolerance's limit by as much is asked apart (`clear_ends`). It is *strict* where no force may be
tensile at any moment; agreement is given for that as well, and for executions whose friction is MuJoCo's own, of a
convex cone (`CONVEX`).
Disagreements are executed again with steps of a quarter, and contacts as much harder, and put into classes.
"""

import argparse
import itertools
import time
from collections import Counter
from collections.abc import Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from flying_plans import plans as flying_plans
from measure import RESULTS, save
from random_plans import plans as stopping_plans

import wholearm_jax as wa
from wholearm_jax.core import Status
from wholearm_jax.ensembles import wilson_interval
from wholearm_jax.execution import CONVEX, ContactCompliance, ExecutionOutcome, Tolerance, execute, touching_contacts_at
from wholearm_jax.files import to_dict
from wholearm_jax.margin import affine_coefficients
from wholearm_jax.model import Arrival, pad_schedule
from wholearm_jax.phases import MAX_OPENING, Result, sample_phase, target_configuration
from wholearm_jax.plotting import LINK_COLOURS as COLOURS

KNOTS, TIMESTEP = 51, 5e-5  # [s]
TOLERANCE = Tolerance()
FREE = 5e-3  # [s] for which a lost contact is tensile, or open; shorter is chatter of the contact's softness
OPEN = 2e-6  # [m] gap above which an executed contact is open
MARGIN_OF_TIME = 0.02  # [s] at either end of a phase, while formations change, in which forces are not judged
PASSED = 0.02  # distance from its path's end, over the tolerance, within which a phase that others follow reached it
HURRY, EARLY = 0.1, 0.05  # speed over the mean speed, and share of the phase left, with which a path's end is too early
SLOW = 0.02  # speed over the mean speed below which an object counts as at rest
PAUSE = 0.1  # [s] for which a pausing plan holds the object
EACH, DRAWS = 2, 12  # variants of each kind, and draws, a plan
PUSHES = 0.25  # share of the draws that push
SHORT = (0.03, 0.3)  # share of its path by which a pushed object falls short, about
CLEAR = 0.05  # distance of the margin from zero, over the mean contact force, from which it is clear
DIP = 0.02  # [s] of tensile force below which a loss is a short dip
NEAR = (0.5, 2.0)  # distances from the planned end, over the tolerance, that are near the limit
NUDGE = 1e-3  # change of all torques that moves the end of a sensitive plan by more than the tolerance
LAST = 0.03  # share of a phase that is its path's end
AROUND, KICK = 0.01, 0.01  # [s] before and after an impact, and share of the speed by which it is off, that count
UNIT = np.array([0.04, 0.04, 1.0, 1.0, 1.0])  # of configurations: the objects' radius, about [m], and radians
PLACES = 1001  # samples a phase
SORTS = {"pausing": 30, "stopping": 10, "flying": 20}  # and how many of each by default, a seed
UNDECIDED = {Status.AMBIGUOUS, Status.SINGULAR, Status.NO_CONVERGENCE, Status.MAX_STEPS}


class Predicted(NamedTuple):
    """What the model says.

    `best_quasistatic_torque_batch` (None: left out), and the same if a force may not be tensile at any moment
    (`strict`); the least force and
    the mean force [N]; the longest time `dip` [s] for which a force is tensile while formations do not change, where
    the least force is (share of its phase), and how far from the planned end, over the tolerance, the object comes.
    """

    result: Result
    courses: list
    holds: bool | None
    strict: bool | None
    margin: float
    mean: float
    dip: float
    place: float
    off: float


# --- predictions ------------------------------------------------------------------------------------------------------

_coefficients = jax.jit(jax.vmap(affine_coefficients, (None, 0)))


def predict(scene: wa.Scene, torque: wa.TorqueSchedule, traced) -> Predicted:
    """Simulate a plan and decide, within `TOLERANCE`, whether it holds."""
    result = wa.simulate(scene, torque, traced=traced)
    courses = [_course(result, phase) for phase in result.phases]
    last = len(result.phases) - 1
    states = [_arrives(p, c, k == last) for k, (p, c) in enumerate(zip(result.phases, courses, strict=True))]
    bears = [_bears(phase) for phase in result.phases]
    lasts = [_lasts(*pair) for pair in zip(result.phases, courses, strict=True)]
    # What follows a phase that fails is not what would happen: its forces do not count.
    known = next((k for k, (a, c) in enumerate(zip(states, lasts, strict=True)) if not (a and c)), len(states) - 1) + 1
    undecided = None in states[:known]
    failed = [[held.margin for held in phase.holds if held.loss_time is not None] for phase in result.phases]
    margins = [min([np.inf if _rests(p) else p.margin, *held]) for p, held in zip(result.phases, failed, strict=True)]
    worst = int(np.argmin(margins[:known]))
    phase, course = result.phases[worst], courses[worst]
    return Predicted(
        result=result,
        courses=courses,
        holds=None if undecided else all(states) and all(lasts),
        strict=None if undecided else all(states) and all(bears),
        margin=margins[worst],
        mean=float(np.nanmean(np.concatenate([c.cn.ravel() for c in courses[:known]]))),
        dip=max(_dip(*pair) for pair in zip(result.phases[:known], courses[:known], strict=True)),
        place=(phase.margin_time - phase.start) / max(float(course.time[-1] - phase.start), 1e-9),
        off=max(_off(*pair) for pair in zip(result.phases[:known], courses[:known], strict=True)),
    )


def _rests(phase) -> bool:
    """Whether a phase only holds the object."""
    return phase.arrive is Arrival.HOLD


def _dip(phase, course) -> float:
    """The longest time [s] for which one of a phase's forces is tensile where executed ones are judged as well."""
    judged = _judged(phase, course, course)
    step = float(course.time[1] - course.time[0])
    return max(_longest(judged & (cn < 0)) for cn in course.cn.T) * step


def _judged(phase, course, of) -> np.ndarray:
    """When forces of a phase are judged, in a course `of` it, `course` being the predicted one."""
    begin, end = course.time[0] + MARGIN_OF_TIME, course.time[-1] - MARGIN_OF_TIME
    moves = np.linalg.norm(of.z_dot / UNIT, axis=1) > SLOW * _pace(phase)
    return (of.time >= begin) & (of.time <= end) & moves & (not _rests(phase))


def _pace(phase) -> float:
    """The mean speed of a phase [1/s]."""
    way = np.asarray(phase.traced.end) - np.asarray(phase.traced.begin)
    return float(np.linalg.norm(way / UNIT) / phase.duration)


def _bears(phase) -> bool:
    """Whether no contact of a phase would have to pull."""
    return phase.contact is None and phase.status is not Status.CONTACT_LOST and bool(np.isfinite(phase.margin))


def _lasts(phase, course) -> bool:
    """Whether no contact of a phase would have to pull for `FREE` or longer, while formations do not change."""
    refused = phase.opening > MAX_OPENING or any(held.loss_time is not None for held in phase.holds)
    return _bears(phase) or (phase.status is Status.CONTACT_LOST and not refused and _dip(phase, course) < FREE)


def _off(phase, course) -> float:
    """How far from where it should a phase ends, over the tolerance."""
    return _apart(course.z[-1], phase)


def _apart(z, phase) -> float:
    """How far a configuration is from where a phase should end, over the tolerance."""
    off = np.asarray(z - target_configuration(phase, phase.traced))
    return float(max(np.hypot(*off[:2]) / TOLERANCE.position, abs(off[2]) / TOLERANCE.angle))


def _course(result, phase):
    """A phase at `BOUND_PLACES` times until its motion ends, also beyond the loss of a contact."""
    outcome, motion = phase.outcome, phase.outcome.motion
    shares = jnp.linspace(0.0, motion.phase_time[motion.count], PLACES)
    schedule = pad_schedule(result.torque)
    return jax.device_get(
        sample_phase(phase.traced.dynamics, schedule, outcome.start, outcome.duration, motion, shares)
    )


def _arrives(phase, course, last: bool) -> bool | None:
    """Whether a phase ends where it should; None where its plan does not say what follows.

    That is so where it comes to its end too early, and where it stops just short, or is late, and others follow: the
    model begins the next phase where its path begins, and the object is not there yet.
    """
    motion = phase.outcome.motion
    ended, length = Status(int(motion.status)), float(phase.traced.dynamics.length)
    share, pace = (float(values[int(motion.count)]) for values in (motion.phase_time, motion.w / length))
    if {ended, phase.status} & UNDECIDED:
        return None
    off = _off(phase, course)
    there = off <= 1
    if _rests(phase):
        return there and phase.status in (Status.OK, Status.CONTACT_LOST)
    passes = phase.arrive is Arrival.MOVING
    if not last and off > PASSED and (there or (passes and ended is Status.OK)):
        return None
    if passes:
        return off <= PASSED
    if there and (pace > HURRY or share < 1 - EARLY):
        return None
    return there


# --- torques ----------------------------------------------------------------------------------------------------------


def base_torques(scene: wa.Scene, traced, optimised: bool) -> wa.TorqueSchedule:
    """The optimised or the quasi-static torques of a plan."""
    if optimised:
        return wa.optimise(scene, knots=KNOTS, traced=traced).torque
    return wa.quasistatic(scene, knots=KNOTS, traced=traced)


def spoiled(base: Predicted, rng: np.random.Generator) -> tuple[str, wa.TorqueSchedule] | None:
    """A variant of the torques, and which kind it is; None where the drawn squeeze does not reach its aim."""
    torque, row_of = base.result.torque, _rows(base.result)
    change = np.zeros((len(torque.times), 2))
    chosen = int(rng.choice([k for k, phase in enumerate(base.result.phases) if not _rests(phase)]))
    rows = row_of == chosen
    course, dynamics = base.courses[chosen], base.result.phases[chosen].traced.dynamics
    s = np.interp(np.asarray(torque.times)[rows], course.time, course.s)
    pull = np.asarray(_coefficients(dynamics, jnp.asarray(np.resize(s, 4 * KNOTS)))[0])[: rows.sum(), 3:]
    if rng.random() < PUSHES:
        duration, size = float(base.result.phases[chosen].duration), (pull**2).sum(1, keepdims=True)
        back = 2 * rng.uniform(*SHORT) * float(dynamics.length) / duration**2
        change[rows] = -back * pull / size
        return "push", wa.TorqueSchedule(torque.times, torque.values + change)
    amount = _squeeze(base, chosen, rng)
    if amount is None:
        return None
    change[rows] = amount * np.stack([-pull[:, 1], pull[:, 0]], axis=1) / np.linalg.norm(pull, axis=1, keepdims=True)
    return "squeeze", wa.TorqueSchedule(torque.times, torque.values + change)


def _rows(result: Result) -> np.ndarray:
    """The phase that each row of a schedule belongs to, by when its phases begin."""
    times = np.asarray(result.torque.times)
    if all(phase.arrive is not Arrival.MOVING for phase in result.phases):
        return np.arange(len(times)) // KNOTS
    return np.searchsorted([phase.start for phase in result.phases], times, side="right") - 1


def _squeeze(base: Predicted, chosen: int, rng: np.random.Generator) -> float | None:
    """How much squeeze, in a direction drawn, moves the least force of a phase to a place drawn about zero."""
    course, phase = base.courses[chosen], base.result.phases[chosen]
    motion, force = (np.asarray(a) for a in _coefficients(phase.traced.dynamics, jnp.asarray(course.s)))
    free = np.stack([-motion[:, 4], motion[:, 3]], axis=1) / np.linalg.norm(motion[:, 3:], axis=1, keepdims=True)
    count = np.isfinite(course.cn).all(0).sum() if np.isfinite(course.cn).any() else 4
    slope = np.einsum("pit,pt->pi", force[:, :count, 3:], free)
    cn = course.cn[:, :count]
    moving = np.isfinite(cn).all(1)
    if count < 4 or not moving.any():
        return None
    aim, sign = base.margin * rng.uniform(-1.0, 0.9), rng.choice([-1.0, 1.0])

    def least(amount):
        return (cn + sign * amount * slope)[moving].min()

    high = 0.01
    while least(high) > aim:
        high *= 2
        if high > 3:
            return None
    low = 0.0
    for _ in range(40):
        middle = (low + high) / 2
        low, high = (middle, high) if least(middle) > aim else (low, middle)
    return float(sign * high)


# --- executions -------------------------------------------------------------------------------------------------------


def executed(
    predicted: Predicted, timestep: float = TIMESTEP, softness: ContactCompliance = ContactCompliance()
) -> dict:
    """One execution: whether it holds, where its phases end, and the longest time that a contact was open."""
    done = execute(predicted.result, timestep=timestep, softness=softness, tolerance=TOLERANCE)
    closed = touching_contacts_at(predicted.result.scene, done.names, done.course.z, OPEN)
    free, which, off = 0.0, None, 0.0
    for phase, course in zip(predicted.result.phases, predicted.courses, strict=True):
        judged = _judged(phase, course, done.course)
        for name in phase.contacts:
            longest = _longest(judged & ~closed[:, done.names.index(name)]) * done.timestep
            if longest > free:
                free, which = longest, name
        if phase.arrive is Arrival.AT_REST:
            off = max(off, _apart(_at(done.course, phase.start + float(phase.duration)), phase))
    holds = done.ending is ExecutionOutcome.OK and free < FREE and off <= 1
    errors = {"position_error": done.position_error, "angle_error": abs(done.angle_error), "off": off}
    found = {"holds": holds, "ending": done.ending.value, "free": free, "free_contact": which, **errors}
    found["creep"] = done.creep
    changes = [phase.start for phase in predicted.result.phases if any(phase.impulses)]
    stops = [phase for phase in predicted.result.phases[1:] if not any(phase.impulses) and not _rests(phase)]
    found |= {"impact": max((_impact(done, when) for when in changes), default=0.0)}
    return found | {"restless": max((_restless(done, phase) for phase in stops), default=0.0)}


def _at(course, time: float) -> np.ndarray:
    """`z` at a time."""
    return np.stack([np.interp(time, course.time, course.z[:, k]) for k in range(5)])


def _restless(done, phase) -> float:
    """How fast an executed object moves where it should set out from rest, beyond the prediction, in mean speeds."""
    moves, should = _speeds(done, phase.start + AROUND)
    return float(np.linalg.norm((moves - should) / UNIT) / _pace(phase))


def _impact(done, when: float) -> float:
    """By how much more of its speed an executed object is off the prediction after a change than before it."""

    def off(time):
        moves, should = _speeds(done, time)
        return np.linalg.norm(moves - should) / max(np.linalg.norm(should), 1e-9)

    return float(off(when + AROUND) - off(when - AROUND))


def _speeds(done, time: float) -> list[np.ndarray]:
    """`z_dot` as executed and as predicted."""
    return [np.stack([np.interp(time, c.time, c.z_dot[:, k]) for k in range(5)]) for c in (done.course, done.expected)]


def _longest(flags) -> int:
    """The length of the longest run of True."""
    return max((len(list(group)) for flag, group in itertools.groupby(flags.tolist()) if flag), default=0)


# --- the study --------------------------------------------------------------------------------------------------------


def variants(scene: wa.Scene, optimised: bool, rng: np.random.Generator) -> Iterator[tuple[str, Predicted]]:
    """Up to `EACH` variants of a plan that are predicted to hold, and as many that are not."""
    traced = wa.trace(scene)
    base = predict(scene, base_torques(scene, traced, optimised), traced)
    wanted = {True: EACH, False: EACH}
    if base.holds is not None:
        wanted[base.holds] -= 1
        yield "as found", base
    for _ in range(DRAWS if base.holds else 0):
        drawn = spoiled(base, rng)
        if drawn is None:
            continue
        predicted = predict(scene, drawn[1], traced)
        if predicted.holds is None:
            yield "left out", predicted
        elif wanted[predicted.holds]:
            wanted[predicted.holds] -= 1
            yield drawn[0], predicted


def row_of(kind: str, predicted: Predicted, found: dict) -> dict:
    """A plan's outcome, and the class of a disagreement."""
    first = next((p for p in predicted.result.phases if p.status is not Status.OK), None)
    row = {
        "kind": kind,
        "predicted": predicted.holds,
        "strict": predicted.strict,
        "status": "ok" if first is None else first.status.label,
        "contact": None if first is None else first.contact,
        "margin": predicted.margin,
        "mean_force": predicted.mean,
        "dip": predicted.dip,
        "place": predicted.place,
        "off": predicted.off,
        "executed": found,
    }
    if predicted.holds != found["holds"]:
        finer = executed(predicted, TIMESTEP / 4)
        row |= {"finer": finer, "class": explain(predicted, found, finer)}
    return row


def explain(predicted: Predicted, found: dict, finer: dict) -> str:
    """Why prediction and execution disagree: the first that applies."""
    lost = -np.inf < predicted.margin < 0
    if finer["holds"] == predicted.holds:
        return "softness: agrees with steps of a quarter"
    if lost and predicted.dip < FREE:
        return f"tensile for less than {1e3 * FREE:g} ms, or only while formations change"
    if lost and predicted.dip < DIP:
        return f"tensile for {1e3 * FREE:g} to {1e3 * DIP:g} ms"
    if abs(predicted.margin) < CLEAR * predicted.mean:
        return "margin within 5 % of the mean force of zero"
    if lost and (predicted.place > 1 - LAST or predicted.place < LAST):
        return "at the path's end"
    apart = max(found["position_error"] / TOLERANCE.position, found["angle_error"] / TOLERANCE.angle, found["off"])
    if not lost and NEAR[0] <= max(predicted.off, apart) <= NEAR[1]:
        return "the end is near the tolerance's limit"
    if finer["impact"] > KICK:
        return "impact: the speed after a change of formation is off by more than 1 %"
    if finer["restless"] > KICK:
        return "it comes to a stop micrometres early or late, and sets out with more than 1 % of its mean speed"
    return "sensitive: 0.1 % of the torque moves the end as far" if _sensitive(predicted) else "unexplained"


def _sensitive(predicted: Predicted) -> bool:
    """Whether a small change of the torques moves the predicted end of a phase by more than the tolerance."""
    result = predicted.result
    traced = tuple(phase.traced for phase in result.phases)
    for factor in (1 - NUDGE, 1 + NUDGE):
        torque = wa.TorqueSchedule(result.torque.times, factor * result.torque.values)
        other = wa.simulate(result.scene, torque, traced=traced)
        for one, phase in zip(predicted.courses, other.phases, strict=True):
            moved = np.asarray(_course(other, phase).z[-1] - one.z[-1])
            if np.hypot(*moved[:2]) > TOLERANCE.position or abs(moved[2]) > TOLERANCE.angle:
                return True
    return False


def _plans(seed: int, wanted: dict[str, int]) -> Iterator[tuple[str, wa.Scene]]:
    """Plans of all sorts, mixed; those that pause and those that stop are not the same."""
    left = dict(wanted)
    stopping = stopping_plans(np.random.default_rng(seed), 2, 1.0)
    found = {"pausing": map(_paused, stopping), "stopping": stopping}
    found["flying"] = flying_plans(np.random.default_rng(seed), 3, 0.4)
    while any(left.values()):
        sort = max(left, key=lambda sort: left[sort] / max(wanted[sort], 1))
        left[sort] -= 1
        yield sort, next(found[sort])


def _paused(scene: wa.Scene) -> wa.Scene:
    """The same plan, which holds the object for `PAUSE` before its last phase."""
    data = to_dict(scene)
    *before, last = data["phase"]
    pause = {"name": "pause", "contacts": before[-1]["contacts"], "hold": True, "duration": PAUSE}
    return wa.parse(data | {"phase": [*before, pause, last]})


def study(scenes, seed: int, begun: float, note) -> tuple[list[dict], int]:
    """All variants of all plans."""
    rng, rows, left_out = np.random.default_rng(seed), [], 0
    for number, (sort, scene) in enumerate(scenes):
        for kind, predicted in variants(scene, sort == "flying" or number % 2 == 0, rng):
            if kind == "left out":
                left_out += 1
                continue
            row = {"seed": seed, "plan": f"{sort}: {scene.title}"} | row_of(kind, predicted, executed(predicted))
            row["convex"] = executed(predicted, softness=CONVEX)["holds"]
            rows.append(row)
            agrees = "" if "class" not in row else f"  DISAGREES: {row['class']}"
            margin = f"{row['margin']:7.3f} N of {row['mean_force']:.2f} N"
            print(f"{number:3d} {kind:9s} {row['status']:13s} {margin}  {row['executed']}{agrees}", flush=True)
        if number % 5 == 4:
            note(rows, left_out)
        print(f"    {time.perf_counter() - begun:.0f} s, {len(rows)} executions", flush=True)
    return rows, left_out


def summarise(rows: list[dict]) -> dict:
    """The confusion matrix and the rates of agreement with Wilson's 95 % intervals."""
    pairs = Counter((row["predicted"], row["executed"]["holds"]) for row in rows)
    names = {True: "holds", False: "fails"}
    matrix = {f"predicted {names[p]}, executed {names[e]}": pairs[p, e] for p in names for e in names}

    def rate(chosen):
        agreed = sum(row.get("agrees", "class" not in row) for row in chosen)
        interval = wilson_interval(agreed, len(chosen)) if chosen else (0.0, 1.0)
        return {"agreed": agreed, "of": len(chosen), "rate": agreed / max(len(chosen), 1), "interval_95": interval}

    def is_clear(row):
        return abs(row["margin"]) > CLEAR * row["mean_force"]

    clear = [row for row in rows if is_clear(row)]
    strict = [row | {"agrees": row["strict"] == row["executed"]["holds"]} for row in rows]
    strict_clear = [row for row in strict if is_clear(row)]
    convex = [row | {"agrees": row["predicted"] == row["convex"]} for row in rows]
    convex_clear = [row for row in convex if is_clear(row)]
    by_sort = {
        f"{sort}, {name}": rate([row for row in some if row["plan"].startswith(sort)])
        for sort in SORTS
        for name, some in (("overall", rows), ("clear", clear))
    }
    classes = Counter(row["class"] for row in rows if "class" in row)
    clear_classes = Counter(row["class"] for row in clear if "class" in row)
    by_seed = {seed: rate([row for row in clear if row["seed"] == seed]) for seed in sorted({r["seed"] for r in rows})}
    by_kind = {kind: rate([row for row in rows if row["kind"] == kind]) for kind in sorted({r["kind"] for r in rows})}
    return {
        "confusion": matrix,
        "overall": rate(rows),
        "clear": rate(clear),
        "clear_ends": rate([row for row in clear if abs(row["off"] - 1) > CLEAR]),
        "strict_overall": rate(strict),
        "strict_clear": rate(strict_clear),
        "convex_overall": rate(convex),
        "convex_clear": rate(convex_clear),
        "convex_flying_clear": rate([row for row in convex_clear if row["plan"].startswith("flying")]),
        "clear_by_seed": by_seed,
        "by_kind": by_kind,
        "by_sort": by_sort,
        "disagreements": dict(classes),
        "clear_disagreements": dict(clear_classes),
    }


def draw(rows: list[dict]) -> plt.Figure:
    """How long a contact was open, and how far off the end was, against the predicted margin."""
    figure, axes = plt.subplots(1, 2, figsize=(8.6, 3.6), sharex=True, layout="constrained")
    for predicted, colour, mark in ((True, COLOURS[0], "o"), (False, COLOURS[1], "x")):
        for agrees, size in ((True, 12), (False, 40)):
            shown = [r for r in rows if r["predicted"] is predicted and ("class" not in r) is agrees]
            at = [r["margin"] / r["mean_force"] for r in shown]
            label = f"predicted to {'hold' if predicted else 'fail'}{'' if agrees else ', executed otherwise'}"
            style = {"s": size, "marker": mark, "color": colour, "linewidths": 0.7 if agrees else 1.8, "label": label}
            axes[0].scatter(at, [1e3 * max(r["executed"]["free"], 1e-4) for r in shown], **style)
            axes[1].scatter(at, [1e3 * max(r["executed"]["position_error"], 1e-7) for r in shown], **style)
    limits = (("longest time that a contact is open [ms]", 1e3 * FREE), ("distance from the planned end [mm]", 0.5))
    for ax, (label, limit) in zip(axes, limits, strict=True):
        ax.axhline(limit, color="#222222", lw=0.8, ls=":")
        ax.axvspan(-CLEAR, CLEAR, color="#dddddd", lw=0, zorder=0)
        ax.set_yscale("log")
        ax.set_xscale("symlog", linthresh=2 * CLEAR)  # most plans lie about zero, a few far from it
        ax.set_xticks([-1, -0.1, 0, 0.1, 1], ["-1", "-0.1", "0", "0.1", "1"])
        ax.set_ylabel(label)
        ax.set_xlabel("predicted least force, over the mean force")
        ax.spines[["top", "right"]].set_visible(False)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=2, frameon=False, fontsize=8)
    return figure


def keep(rows: list[dict], left_out: int) -> None:
    """Write what was found, and draw it."""
    counts = {"plans": len({(row["seed"], row["plan"]) for row in rows}), "executions": len(rows), "left_out": left_out}
    limits = {"free": FREE, "open": OPEN, "timestep": TIMESTEP, **TOLERANCE._asdict(), "clear": CLEAR}
    save("prediction", {**counts, **limits, **summarise(rows), "rows": rows})
    draw(rows).savefig(RESULTS / "prediction.svg", bbox_inches="tight")
    plt.close("all")


def main() -> None:
    wa.configure()
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for sort, count in SORTS.items():
        parser.add_argument(f"--{sort}", type=int, default=count, help=f"{sort} plans")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1], help="one study each, together")
    parser.add_argument("--quick", action="store_true", help="a few plans; nothing is written")
    given = parser.parse_args()
    wanted = {sort: 1 if given.quick else getattr(given, sort) for sort in SORTS}
    begun = time.perf_counter()

    rows, left_out = [], 0

    def note(more, more_left_out):
        if not given.quick:
            keep([*rows, *more], left_out + more_left_out)

    for seed in given.seeds:
        found = study(_plans(seed, wanted), seed, begun, note)
        rows, left_out = [*rows, *found[0]], left_out + found[1]
        note([], 0)
    for name, value in summarise(rows).items():
        print(name, value)


if __name__ == "__main__":
    main()
