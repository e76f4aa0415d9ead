"""Design a controller: the curve of joint angles of each path, a reference along it, its torques, and the gains."""

import itertools
from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from wholearm_jax.core import Status, require_positive
from wholearm_jax.feedback.controller import Controller, PhaseLaw
from wholearm_jax.feedback.either_formation import UNSURE, find_takeovers, with_either_formation, with_hand_overs_judged
from wholearm_jax.feedback.law_tables import law_tables
from wholearm_jax.feedback.path_table import (
    PathTable,
    PathTerms,
    path_terms,
    tabulate_path,
    terms_of_other_shape,
    with_facets,
)
from wholearm_jax.feedback.reference_motion import (
    PASSING,
    ReferenceMotion,
    passing_motion,
    scheduled_motion,
    smooth_motions,
)
from wholearm_jax.feedback.stop_places import SHAPES_AT_STOPS, draw_shapes, has_paths, stop_places
from wholearm_jax.feedback.stop_torque import StopStatics, choose_push, object_at_stop, slowness, stays_at_stop
from wholearm_jax.feedback.torque_choice import CostUnits, TorqueChoice, choose_torques, cost_units
from wholearm_jax.model import Arrival, Scene, TorqueSchedule
from wholearm_jax.phases import (
    CLOSED_LOOP_TOLERANCE,
    Result,
    SimulatedPhase,
    TracedPhase,
    ends_at_stop,
    group_phases,
    require_motion,
    simulate,
    simulate_closed_loop,
    trace,
    trajectory,
)
from wholearm_jax.simulation import IntegratorOptions

RATES = {"stiffness": 60.0, "integral": 10.0, "observer": 200.0}  # of an object that is not large (`slowness`) [1/s]
ENCODER_COUNTS = 4096  # a turn, unless another encoder is given
HASTE = 1.2  # largest speed that a step of such an encoder causes, over the mean speed of the slowest phase
SETTLED = 20.0  # least stiffness times the shortest phase's duration: in the bundled plans 15 and more
RESERVE = 0.9  # fraction of the torque limits that the reference's torques and their corrections stay within
PUSH = 0.3  # largest torque of the feedback on the way, over the torque limit
BEYOND = 0.06  # how far the reference goes on beyond the path's end, to meet the contact that ends it [rad]
APPROACH = 0.15  # speed with which, at least, of an object that is not large [rad/s]
SLOW_SHARE = 0.4  # of a phase's duration, at most, that the reference takes to cross where stops of other parts may be
FELT = (0.05, 0.03)  # speed [rad/s] below which such an object stands, and for how long [s]
LONGEST_DELAY = 1.0  # longest time beyond a phase's duration, for such an object [s]
ASIDE = 0.02  # how far an object may be from the reference's place on its path: 0.5 mm of a radius of 25 mm [rad]


class Part(NamedTuple):
    """An object that a law is designed with, and its paths; one that need not be held only says where it stops."""

    scene: Scene
    paths: tuple[TracedPhase, ...]
    is_held: bool
    has_other_shape: bool


class Approach(NamedTuple):
    """How a phase comes to its end: the last part of the path is slow before a stop, and the reference reaches on."""

    slow: float  # [rad]
    speed: float  # [rad/s]
    reach: float  # [rad]


def feedback(
    scene: Scene,
    schedule: TorqueSchedule,
    *,
    friction: float = 0.2,
    mass: float = 0.0,
    stiffness: float | None = None,
    integral: float | None = None,
    observer: float | None = None,
    shape: float | None = None,
    own_motion: bool = False,
) -> Controller:
    """Design a closed-loop law for a plan (`docs/feedback.md`).

    Torques and gains are chosen for the largest least force over the scene and those whose friction, link by link, and
    mass are at the ends of their ranges, and, where a `shape` is given, over drawn parts of other shape. Then all of
    these are simulated under the law. Each phase's `margin` is the least force of both; where it is negative, some
    object of the set cannot be held by this law.

    Args:
        scene: Scene with its plan.
        schedule: Torque schedule that covers the plan; it gives the motion, or the speeds ratios where phases follow
            one another without a stop.
        friction: Half width of each link's friction, relative.
        mass: Half width of the mass, relative.
        stiffness: Natural frequency `w` of the loop [1/s], 60 unless given; less for a large object or a slow motion,
            as the other rates.
        integral: Rate of its integral part [1/s], 10 unless given.
        observer: Rate of the filter for place and speed [1/s], 200 unless given.
        shape: Half width of the vertices' coordinates [m] of parts that have to be held, too. Phases that end at a stop
            approach it slowly from where that of such a part may be, first, and go on to where it may be, last; for
            that alone it is 1 % of the object's radius unless given.
        own_motion: Follow the schedule's own motion, instead of the smooth one with the largest margin.

    Returns:
        The controller.

    Raises:
        ValueError: For numbers that are out of range, for a plan whose paths cannot be traced, where both joints stand
            still on a path, and where a schedule fails whose motion is asked for.
    """
    rates = {"stiffness": stiffness, "integral": integral, "observer": observer}
    given = {name: rate for name, rate in rates.items() if rate is not None}
    require_positive(**given)
    if not (0 <= friction < 1 and 0 <= mass < 1):
        raise ValueError("friction, mass: shares of at least 0 and less than 1")
    require_motion(scene)
    result = simulate(scene, schedule)
    for phase in result.phases:
        if int(phase.traced.dynamics.status) != Status.OK:
            raise ValueError(phase.message)
    _require_motions(result, own_motion)
    scenes = corner_scenes(scene, friction, mass)
    traces = [tuple(phase.traced for phase in result.phases), *(trace(other) for other in scenes[1:])]
    tables = _path_tables(scene, traces[0])
    shapes = draw_shapes(scenes, shape)
    drawn = [trace(other) for other in shapes]
    others = draw_shapes([scene], shape, seed=1, count=SHAPES_AT_STOPS - len(drawn))
    approaches = _approaches(scene, traces[0], tables, [*drawn, *map(trace, others)])
    held = drawn if shape else []  # the others only say where stops may be
    terms = [
        _terms_of_set(table, [paths[k] for paths in traces], [paths[k] for paths in held if has_paths(paths[: k + 1])])
        for k, table in enumerate(tables)
    ]
    takeovers = find_takeovers(scene, traces[0])
    either = with_either_formation(tables, terms, takeovers)
    limit, units = RESERVE * np.asarray(scene.hand.torque_limit), cost_units(scene)
    parts = [Part(*each, is_held=True, has_other_shape=False) for each in zip(scenes, traces, strict=True)]
    parts += [Part(*each, is_held=bool(held), has_other_shape=True) for each in zip(shapes, drawn, strict=True)]
    laws = []
    for group in group_phases(scene):
        options = _motions(scene, group, tables, approaches, trajectory(result), own_motion)
        choices = [
            [_choose(either[k], tables[k], limit, m, units) for k, m in zip(group, o, strict=True)] for o in options
        ]
        best = max(range(len(choices)), key=lambda option: _worst_first(choices[option]))
        for k, motion, choice in zip(group, options[best], choices[best], strict=True):
            sure = UNSURE if k > 0 and takeovers[k - 1] else 0.0
            laws.append(_phase_law(scene, k, tables[k], terms[k][0], motion, choice, approaches[k], parts, sure))
    slow = slowness(scene)
    first, *others = [defaults | given for defaults in _default_rates(scene, tables)]
    controller = Controller(
        title=scene.title,
        phases=tuple(laws),
        **first,
        push=_push(scene),
        felt=(FELT[0] / slow, FELT[1] * slow),
        patience=LONGEST_DELAY * slow,
        torque_limit=np.asarray(scene.hand.torque_limit),
    )
    held = _with_simulated_margins(with_hand_overs_judged(controller, either, takeovers), parts)
    for faster in others if held.margin <= 0 else ():
        if faster != first:  # not all rates are given
            another = with_hand_overs_judged(replace(controller, **faster), either, takeovers)
            held = max(held, _with_simulated_margins(another, parts), key=lambda one: one.margin)
    return held


def _path_tables(scene: Scene, paths) -> list[PathTable]:
    """Tabulate a plan's paths. Raises ValueError, with the phase's name, where joint angles do not tell a place."""
    tables = []
    for phase, path in zip(scene.phases, paths, strict=True):
        try:
            tables.append(tabulate_path(path.dynamics))
        except ValueError as error:
            raise ValueError(f"'{phase.name}': {error}") from None
    return tables


def _default_rates(scene: Scene, tables: list[PathTable]) -> list[dict[str, float]]:
    """Return rates of the loop to try: less for large objects, and for motions so slow that an encoder's steps reverse.

    Each step of the measured angle moves the object at about `w` times the step, which is too much for slow motions.
    But the loop has to settle within the shortest phase, also where another one is so short a path that it is slow; and
    where no law holds at the lower rates, one may at those of faster motions.
    """
    durations = [float(phase.duration) for phase in scene.phases]
    slowest = min(float(table.s[-1]) / duration for table, duration in zip(tables, durations, strict=True))
    stiffness = max(HASTE * slowest * ENCODER_COUNTS / (2 * np.pi), SETTLED / min(durations))
    usual = 1 / slowness(scene)
    shares = sorted({min(usual, stiffness / RATES["stiffness"]), usual})
    return [{name: share * rate for name, rate in RATES.items()} for share in shares]


def _worst_first(choices: list[TorqueChoice]) -> list[float]:
    """Return the margins of a group's phases, the least first: of motions that have that alike the others decide."""
    return sorted(float(f"{choice.margin.min():.6g}") for choice in choices)


def _require_motions(result: Result, own_motion: bool) -> None:
    """Raise ValueError where a schedule fails whose motion is asked for, by itself or for the speeds to pass with."""
    for group in group_phases(result.scene):
        failed = next((result.phases[k].message for k in group if result.phases[k].status != Status.OK), None)
        if failed and (own_motion or len(group) > 1):
            name = result.phases[group[0]].name
            why = "follow the schedule's motion" if own_motion else "follow one another without a stop"
            raise ValueError(f"laws from {name} on {why}, which has to succeed (`optimise` finds one): {failed}")


def _with_simulated_margins(controller: Controller, parts: list[Part]) -> Controller:
    """Lower the margins of a controller to those of the parts to be held, simulated under it.

    The choice of torques lets every object move as the reference does; in closed loop one of other friction is late,
    or early, until the loop has made up for it. Of the planned shape, every object has to end each phase as planned.
    """
    tables, options = law_tables(controller), IntegratorOptions(tolerance=CLOSED_LOOP_TOLERANCE)
    held = [part for part in parts if part.is_held and has_paths(part.paths)]
    runs = [simulate_closed_loop(part.scene, tables, part.paths, options) for part in held]
    margins = np.array([[_least_force(phase, part) for phase in run] for part, run in zip(held, runs, strict=True)])
    least = np.where(np.isnan(margins).any(0), -np.inf, margins.min(0)).tolist()
    phases = zip(controller.phases, least, strict=True)
    return replace(controller, phases=tuple(replace(law, margin=min(law.margin, margin)) for law, margin in phases))


def _least_force(phase: SimulatedPhase, part: Part) -> float:
    """Return the least force of a simulated phase [N]; minus infinity where it does not end as it should."""
    ends = part.has_other_shape or int(phase.assessment.status) in (Status.OK, Status.CONTACT_LOST)
    return float(phase.margin_result.margin) if ends else -np.inf


def _terms_of_set(table: PathTable, alike: list[TracedPhase], other_shapes: list[TracedPhase]) -> list[PathTerms]:
    """Return the terms of all objects that have to be held on a path: the nominal one first, also a little aside."""
    terms = [path_terms(path.dynamics, table) for path in alike]
    terms += [terms_of_other_shape(path.dynamics, table) for path in other_shapes]
    return terms + [_displaced(terms[0], table, by) for by in (-ASIDE, ASIDE)]


def _displaced(terms: PathTerms, table: PathTable, by: float) -> PathTerms:
    """Return the terms of an object that is elsewhere on its path than where the reference is."""
    return terms.at(_nearest(table, table.s + by))


def _nearest(table: PathTable, places: Float[np.ndarray, "places"]) -> Int[np.ndarray, "places"]:
    """Return the nodes next to places on a path."""
    return np.abs(places[:, None] - table.s).argmin(1)


def _push(scene: Scene) -> float:
    """Return the largest torque of the feedback on the way [N m]."""
    return PUSH * float(np.max(scene.hand.torque_limit))


def _approaches(
    scene: Scene, traced: tuple[TracedPhase, ...], tables: list[PathTable], drawn: list[tuple[TracedPhase, ...]]
) -> list[Approach | None]:
    """Say how each phase approaches its end; None where it ends by the clock, as nothing stops the object there.

    One that flows into the next goes on beyond the nominal end, for parts that come to theirs later; after the last
    phase there is nothing to go on to.
    """
    found: list[Approach | None] = []
    least = APPROACH / slowness(scene)
    rows = zip(scene.phases, traced, tables, stop_places(tables, drawn), strict=True)
    for k, (phase, path, table, stop) in enumerate(rows):
        if phase.arrive is Arrival.MOVING:
            is_last = k == len(tables) - 1
            found.append(None if is_last else Approach(0.0, 0.0, BEYOND + stop.beyond))
            continue
        length, duration, slow = float(table.s[-1]), float(phase.duration), stop.before
        speed = max(least, slow / (SLOW_SHARE * duration))
        if length - slow < speed * (duration - slow / speed):  # it is slow anyway
            slow, speed = 0.0, least
        stays = ends_at_stop(scene, phase, path) and stays_at_stop(object_at_stop(scene, phase, path))
        found.append(Approach(slow, speed, max(slow, BEYOND + stop.beyond)) if stays else None)
    return found


def _motions(scene: Scene, group, tables, approaches, courses, own_motion: bool) -> list[list[ReferenceMotion]]:
    """Motions to choose from, one a phase of the group in each."""
    if own_motion:
        return [[scheduled_motion(tables[k], courses[k]) for k in group]]
    durations = [float(scene.phases[k].duration) for k in group]
    lengths = [tables[k].s[-1] for k in group]
    if len(group) == 1:
        approach = approaches[group[0]] or Approach(0.0, 0.0, 0.0)
        return [[motion] for motion in smooth_motions(lengths[0], durations[0], approach.slow, approach.speed)]
    stop = approaches[group[-1]] or Approach(0.0, 0.0, 0.0)
    speed = [np.hypot(*np.asarray(courses[k].z_dot)[[0, -1], 3:].T) for k in group]
    ratios = [after[0] / before[1] for before, after in itertools.pairwise(speed)]  # of the impacts
    options = []
    for share in PASSING:
        exits = [share * length / time for length, time in zip(lengths[:-1], durations, strict=False)]
        entries = [0.0, *(ratio * v for ratio, v in zip(ratios, exits, strict=True))]
        *on_the_way, last = zip(lengths, durations, entries, [*exits, 0.0], strict=True)
        options.append([*(passing_motion(*each) for each in on_the_way), passing_motion(*last, stop.slow, stop.speed)])
    return options


def _choose(every: list[PathTerms], table: PathTable, limit, motion: ReferenceMotion, units: CostUnits) -> TorqueChoice:
    """Choose torques and gains at the nodes next to a motion's places."""
    nodes = _nearest(table, motion.s)
    facets = max(terms.slack.shape[1] for terms in every)
    at = [PathTerms(terms.acceleration, with_facets(terms.slack, facets)).at(nodes) for terms in every]
    return choose_torques(at, limit, motion.v, motion.a, units)


def corner_scenes(scene: Scene, friction: float, mass: float) -> list[Scene]:
    """Return the scene, and those with the friction of each link and the mass at ends of their ranges.

    Of the sixteen corners these are the eight in which an even number of quantities is low.
    """
    if friction == 0 and mass == 0:
        return [scene]
    corners = []
    for signs in itertools.product((-1.0, 1.0), repeat=3):
        lighter = eqx.tree_at(lambda s: s.object.mass, scene, scene.object.mass * (1 + mass * np.prod(signs)))
        slip = scene.object.friction * (1 + friction * np.array(signs))
        corners.append(eqx.tree_at(lambda s: s.object.friction, lighter, slip))
    return [scene, *corners]


def _phase_law(
    scene: Scene,
    k: int,
    table: PathTable,
    terms: PathTerms,
    motion: ReferenceMotion,
    choice: TorqueChoice,
    approach: Approach | None,
    parts: list[Part],
    sure: float,
) -> PhaseLaw:
    """Put the law of phase `k` together, for the nominal object's `terms` and the stops of all parts with paths.

    A stop's own feedback begins beyond the place `sure`: up to there, that of the choice moves the object under either
    formation of a hand-over.
    """
    phase = scene.phases[k]
    gain = np.stack([np.interp(table.s, motion.s, choice.gain[:, j]) for j in range(2)], axis=1)
    flows, margin = phase.arrive is Arrival.MOVING, float(choice.margin.min())
    press, speed = 0.0, APPROACH / slowness(scene)
    reach = min(approach.reach, float(table.s[-1]) - sure) if approach is not None else 0.0
    if approach is not None and not flows:
        speed = approach.speed
        press, gain_at_stop, held = _push_at_stop(scene, k, parts, choice.torque[-1], speed)
        gain[table.s > table.s[-1] - reach], margin = gain_at_stop, min(margin, held)
    gain /= (gain * terms.acceleration[:, 3:]).sum(1, keepdims=True)
    if approach is not None and flows:  # it goes on as it comes, and nothing bounds the feedback more than on the way
        press, speed = _push(scene) / float(np.abs(gain).max(1).min()), float(motion.v[-1])
    return PhaseLaw(
        name=phase.name,
        contacts=phase.formation.names,
        flows=flows,
        s=table.s,
        theta=table.theta,
        tangent=table.tangent,
        gain=gain,
        time=motion.time,
        s_ref=motion.s,
        v_ref=motion.v,
        torque=choice.torque,
        reach=reach,
        approach=speed,
        press=press,
        margin=margin,
    )


def _push_at_stop(
    scene: Scene, k: int, parts: list[Part], torque: Float[np.ndarray, "2"], speed: float
) -> tuple[float, Float[np.ndarray, "2"], float]:
    """Choose the push with which phase `k` comes to its stop: its size, its torques, and what it leaves as `margin`.

    It is meant for all parts that come there; where that loses one that has to be held, for these alone.
    """
    phase, limit = scene.phases[k], np.asarray(scene.hand.torque_limit)
    stopped = [part for part in parts if has_paths(part.paths[: k + 1])]
    every = [object_at_stop(part.scene, phase, part.paths[k]) for part in stopped]
    held = [stop for stop, part in zip(every, stopped, strict=True) if part.is_held]
    either = not phase.has_free_finger

    def push_for(stops: list[StopStatics]) -> tuple[float, Float[np.ndarray, "2"], float]:
        press, gain = choose_push(stops, torque, limit, either_finger=either, bound=_push(scene))
        pressed = torque + press * gain
        return press, gain, min(stop.pressed_over(pressed, speed, either_finger=either) for stop in held)

    push = push_for(every)
    return push if push[2] > 0 or len(held) == len(every) else max(push, push_for(held), key=lambda one: one[2])
