r"""Search from a configuration to a goal, over the moves between contact formations.

Nodes are configurations; moves lead from one to the next (`moves_from`). A move may be left at its path's end, where a
coordinate of the goal has its value, or at places between, from where others may begin: at its thirds at once, at finer
fractions later, as if they took a phase or two more (an object may be tipped from a small part of a slide only). The
search is best-first, by the number of phases and an estimate of those still needed, and drops moves whose margin is
below the floor. Two orders take turns: by their sum, for plans of up to `SHORT_PLAN` phases, and with more weight on
the estimate, which goes for a plan of any length. A plan that is found is traced anew, at full resolution, and judged
by its certificate: the least, over its phases, of the largest margins of all motions along their paths.
Once there are as many plans as wanted, the floor rises to the least certificate among them, so that from then on only
better ones count; the search ends when it has gone on as long again without finding one. Last, the places between the
phases of the plans that are kept move until their certificates are as large as they get (`improve_plan`).
"""

import functools
import heapq
import itertools
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import equinox as eqx
import numpy as np

from wholearm_jax.core import as_device_array, require_x64, wait_for
from wholearm_jax.model import (
    ANGLE_COORDINATES,
    AWAY_NAMES,
    Scene,
    feature_pair,
    object_radius,
    rigid_body,
)
from wholearm_jax.phases import describe_overlaps, possible_hand_overs, trace
from wholearm_jax.planning.goal import Goal, make_goal
from wholearm_jax.planning.improvement import improve_plan, is_secure
from wholearm_jax.planning.move_stops import move_stops
from wholearm_jax.planning.moves import SHORTEST_MOVE, Move, moves_from
from wholearm_jax.planning.obstructions import explain_failure, explain_vain_search
from wholearm_jax.planning.plans import (
    Edge,
    Plan,
    PlanningResult,
    Step,
    contact_left,
    make_plan,
    precompile_certificates,
    survives_hand_over,
)
from wholearm_jax.planning.regrasps import regrasp_stops, separate_regrasps
from wholearm_jax.planning.successors import touching_contacts

BEYOND_BEGIN = 1e-3  # how far beyond a step's begin a move back leads on, at least [object radii, rad]
MERGE_TOL = 1e-5  # configurations closer than this, in object radii and radians, are one node
TYPICAL_SHIFT, TYPICAL_TURN = 0.5, 0.5  # of one move [object radii, rad], for the estimate of phases to come
SHORT_PLAN = 5  # phases
ESTIMATE_WEIGHT = 3.0  # in the order for longer plans
SEARCH_PATIENCE = 1.0  # nodes without a better plan, over those up to the last one,
LEAST_PATIENCE = 40  # and at least so many


@dataclass
class _Search:
    """State of a search."""

    scene: Scene
    start: np.ndarray
    goal: Goal
    floor: float
    unit: np.ndarray  # (5,) of the coordinates: lengths in radii
    max_phases: int
    duration: float
    count: int
    rolling: bool
    regrasp_cost: float | None
    queues: tuple[list[Any], list[Any]] = field(default_factory=lambda: ([], []))  # for short plans, for longer ones
    taken: set[int] = field(default_factory=set)  # numbers of the entries that have left one of them
    visited: set[tuple[Any, ...]] = field(default_factory=set)
    order: Any = field(default_factory=itertools.count)
    nearest: tuple[float, tuple[Step, ...]] = (np.inf, ())
    plans: list[Plan] = field(default_factory=list)
    graph: list[Edge] = field(default_factory=list)
    nodes: int = 0
    moves: int = 0
    nodes_of_last_plan: int = 0


def plan(
    scene: Scene,
    goal: Mapping[str, float] | None = None,
    *,
    by: Mapping[str, float] | None = None,
    tolerance: Mapping[str, float] | None = None,
    margin: float = 0.0,
    count: int = 3,
    max_phases: int = 24,
    rolling: bool = True,
    regrasp_cost: float | None = None,
    time_limit: float = 60.0,
    max_nodes: int | None = None,
    duration: float = 1.0,
    callback: Callable[[int, float], None] | None = None,
) -> PlanningResult:
    """Plan contact formations that lead an object from a scene's start to a goal.

    Args:
        scene: the hand, the object and the start; its phases, if any, only say what touches at the start.
        goal: absolute values of the coordinates that matter (`x, y, phi, theta1, theta2`; m, rad).
        by: displacements of coordinates, instead.
        tolerance: distances from the goal that are good enough; 1 mm and 1 degree unless given.
        margin: least margin [N] that a plan must allow.
        count: number of plans to return at most.
        max_phases: longest plan.
        rolling: whether contacts may roll.
        regrasp_cost: allow regrasps: a finger may leave the object, stand still away from it while the other one moves
            the object, and touch it again. Each time that a finger moves alone counts as so many phases more. None: no
            regrasps.
        time_limit: seconds of search, compiling left out, after which it ends with what it has.
        max_nodes: configurations to expand at most: unlike time, the same on every machine.
        duration: of each phase [s].
        callback: called with the number of configurations expanded and the distance of the nearest.

    Returns:
        Plans, best first: the largest certificate, then fewer phases. Where there is none, the nearest configuration
        and what stands in the way there.

    Raises:
        ValueError: for a goal that cannot be understood.
        RuntimeError: without float64.
    """
    require_x64(scene)
    if regrasp_cost is not None and not 0 <= regrasp_cost < np.inf:
        raise ValueError(f"regrasp_cost must be a number of at least 0, not {regrasp_cost}")
    start, touching = _start(scene)
    radius = object_radius(scene.object)
    search = _Search(
        scene=scene,
        start=start,
        goal=make_goal(start, goal, by=by, tolerance=tolerance),
        floor=margin,
        unit=np.array([radius, radius, 1, 1, 1]),
        max_phases=max_phases,
        duration=duration,
        count=count,
        rolling=rolling,
        regrasp_cost=regrasp_cost,
    )
    overlaps = describe_overlaps(scene, as_device_array(start))
    vain = explain_vain_search(start, search.goal, scene.hand, overlaps)
    if vain:
        return PlanningResult(start, search.goal, (), None, f"no plan: {vain}", 0, 0, ())
    _push(search, start, (), touching)
    out_of_time = _run(search, time_limit, max_nodes, callback)
    nearest, reason = None, ""
    again = functools.partial(_make_secure_plan, search)
    improved = [improve_plan(one, search.unit, again) for one in search.plans]
    if not search.plans:
        steps = search.nearest[1]
        nearest = make_plan(scene, start, steps, duration, None) if steps else None
        here = nearest.ends[-1] if nearest is not None else start
        moves = moves_from(scene, as_device_array(here), rolling=rolling, regrasps=regrasp_cost is not None)
        nearer = [move for move in moves if _phases_to_go(search, move.places[1]) < _phases_to_go(search, here) - 1e-6]
        reason = explain_failure(search.goal, here, nearer, search.floor, out_of_time=out_of_time)
    return PlanningResult(
        start=start,
        goal=search.goal,
        plans=tuple(_ranked(search, improved)),
        nearest=nearest,
        reason=reason,
        nodes=search.nodes,
        moves=search.moves,
        graph=tuple(search.graph),
        out_of_time=out_of_time,
        distance=search.nearest[0],
    )


def _start(scene: Scene) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return the start and what touches there: of the first phase's path if there is one, else of the start itself."""
    first = eqx.tree_at(lambda s: s.phases, scene, scene.phases[:1])
    z = np.asarray(trace(first)[0].begin if scene.phases else scene.start)
    return z, touching_contacts(scene, as_device_array(z))


def _run(
    search: _Search, time_limit: float, max_nodes: int | None, callback: Callable[[int, float], None] | None
) -> bool:
    """Expand configurations until nothing is left, plans no longer get better, or time is out; say whether it is."""
    compiled = precompile_certificates()
    begin = time.monotonic()
    for z, steps, names in _next_entries(search):
        if steps and min(step.margin for step in steps) <= search.floor:  # the floor has risen
            continue
        if steps and search.goal.is_reached(z):
            _add_plan(search, steps)
            continue
        if search.plans and _has_lost_patience(search):
            return False
        if time.monotonic() - begin > time_limit or search.nodes == max_nodes:
            _add_waiting_plans(search)
            return True
        _expand(search, z, steps, names)
        if search.nodes == 1:  # the first expansion compiles: that is no time of the search
            wait_for(compiled)
            begin = time.monotonic()
        if callback is not None:
            callback(search.nodes, search.nearest[0])
    return False


def _next_entries(search: _Search) -> Iterator[tuple[np.ndarray, tuple[Step, ...], tuple[str, ...] | None]]:
    """Take entries from the two queues in turn, each entry once, until both are empty."""
    for queue in itertools.cycle(search.queues):
        while queue:
            _, number, *entry = heapq.heappop(queue)
            if number not in search.taken:
                search.taken.add(number)
                yield tuple(entry)
                break
        if not any(search.queues):
            return


def _add_waiting_plans(search: _Search) -> None:
    """Add plans that have been found but not judged, those first that would have been, until there are enough."""
    waiting = {number: (z, steps) for queue in search.queues for _, number, z, steps, _ in queue}
    order = {number: (_cost(search, steps) + _delay(steps), number) for number, (_, steps) in waiting.items()}
    for number in sorted(waiting, key=order.__getitem__):
        z, steps = waiting[number]
        if len(search.plans) == search.count:
            return
        if number not in search.taken and steps and search.goal.is_reached(z):
            _add_plan(search, steps)


def _has_lost_patience(search: _Search) -> bool:
    waited = search.nodes - search.nodes_of_last_plan
    return waited > max(LEAST_PATIENCE, SEARCH_PATIENCE * search.nodes_of_last_plan)


def _add_plan(search: _Search, steps: tuple[Step, ...]) -> None:
    """Trace steps as a plan, and keep it if it arrives and is among the best; the floor rises to the last of these."""
    found = _make_plan(search, steps, search.floor)
    if found is None:
        return
    ranked = _ranked(search, [*search.plans, found])
    different = {}  # plans of the same formations that change elsewhere are one
    for one in ranked:
        different.setdefault(tuple((step.contacts, step.toward) for step in one.steps), one)
    if all(one is not found for one in different.values()):
        return
    search.nodes_of_last_plan = search.nodes
    search.plans[:] = list(different.values())[: search.count]
    if len(search.plans) == search.count:
        search.floor = search.plans[-1].bound


def _make_plan(search: _Search, steps: tuple[Step, ...], floor: float) -> Plan | None:
    """Trace steps as a plan with a certificate above a floor, if they are one."""
    return make_plan(search.scene, search.start, steps, search.duration, search.goal, floor)


def _make_secure_plan(search: _Search, steps: tuple[Step, ...], floor: float) -> Plan | None:
    """Trace steps as a plan, if they are one that the search itself might have found."""
    found = _make_plan(search, steps, floor)
    regrasps = search.regrasp_cost is not None
    return found if found is not None and is_secure(found, regrasps=regrasps) else None


def _ranked(search: _Search, plans: list[Plan]) -> list[Plan]:
    """Sort plans: the largest certificate first, then fewer phases."""
    return sorted(plans, key=lambda one: (-round(one.bound, 6), _cost(search, one.steps)))


def _push(search: _Search, z: np.ndarray, steps: tuple[Step, ...], touching: tuple[str, ...] | None) -> None:
    """Add a configuration to the queues unless it is there already, or no plan may go on from it."""
    key = (contact_left(steps), *np.round(z / search.unit / MERGE_TOL).astype(int).tolist())
    arrived = search.goal.is_reached(z)
    if key in search.visited and not arrived:  # other ways to the goal are other plans
        return
    search.visited.add(key)
    distance = _phases_to_go(search, z)
    if distance < search.nearest[0] - 1e-9:
        search.nearest = (distance, steps)
    entry, (short, long) = (next(search.order), z, steps, touching), search.queues
    spent, to_go = _cost(search, steps), distance + _delay(steps)
    if len(steps) < min(SHORT_PLAN, search.max_phases) or arrived:
        heapq.heappush(short, (spent + to_go, *entry))
    if search.max_phases > SHORT_PLAN and (len(steps) < search.max_phases or arrived):
        heapq.heappush(long, (spent + ESTIMATE_WEIGHT * to_go, *entry))


def _cost(search: _Search, steps: tuple[Step, ...]) -> float:
    """Count phases, each regrasp with its price."""
    return len(steps) + (search.regrasp_cost or 0.0) * sum(step.regrasp is not None for step in steps)


def _delay(steps: tuple[Step, ...]) -> float:
    """Return by how many phases later the search goes on from the end of some steps."""
    return sum(step.delay for step in steps)


def _phases_to_go(search: _Search, z: np.ndarray) -> float:
    """Estimate how many moves lead from a configuration to the goal; 0 within its tolerances."""
    shift = TYPICAL_SHIFT * search.unit[0]
    sizes = [TYPICAL_TURN if name in ANGLE_COORDINATES else shift for name in search.goal.values]
    return float((np.maximum(search.goal.distance(z) - search.goal.limits, 0.0) / sizes).sum())


def _expand(search: _Search, z: np.ndarray, steps: tuple[Step, ...], touching) -> None:
    """Trace all moves from a configuration and push the places at which they may be left."""
    regrasps = search.regrasp_cost is not None
    left, here = contact_left(steps), as_device_array(z)
    options = {"rolling": search.rolling, "regrasps": regrasps, "floor": search.floor}
    moves = moves_from(search.scene, here, touching, left=left, **options)
    search.nodes += 1
    search.moves += len(moves)
    alone, others = separate_regrasps(moves) if regrasps else ((), moves)
    stops = [
        (move, stop)
        for move in others
        if _leads_on(search, steps, move)
        for stop in move_stops(move, search.goal, search.unit)
    ]
    last = steps[-1].regrasp if steps else None
    survives = _hand_over_check(search, steps)
    capacity = search.scene.object.vertices.shape[0]
    stops += [(move, stop) for move in alone for stop in regrasp_stops(move, capacity, last, search.goal.values)]
    for move, (step, is_end) in stops:
        if step.margin > search.floor and survives(move, step):
            search.graph.append(Edge(z, step.end, step.margin))
            # Along the path of a finger alone, more may touch than what holds the object.
            seen = None if is_end or step.regrasp else _names(move)
            _push(search, step.end, (*steps, step), seen)


def _leads_on(search: _Search, steps: tuple[Step, ...], move: Move) -> bool:
    """Say whether a move is a new one: not on along the last step's path, nor back to where that began.

    A little beyond there, where a move from there would have been too short, it is one: it ends at another contact.
    """
    if not steps or move.contacts != steps[-1].contacts:
        return True
    beyond = np.abs(move.places[-1] - _begin_of_last(search, steps)) / search.unit
    return bool(BEYOND_BEGIN < beyond.max() <= SHORTEST_MOVE)


def _begin_of_last(search: _Search, steps: tuple[Step, ...]) -> np.ndarray:
    """Return the configuration at which the last of some steps began."""
    return steps[-2].end if len(steps) > 1 else search.start


def _hand_over_check(search: _Search, steps: tuple[Step, ...]) -> Callable[[Move, Step], bool]:
    """Return what says whether torques survive the hand-over, if any, from the last step to a move."""
    count, known, last = int(rigid_body(search.scene.object).count), {}, steps[-1] if steps else None

    def survives(move: Move, step: Step) -> bool:
        if last is None or not any(possible_hand_overs(last.contacts, move.contacts, count)):
            return True
        if move.contacts not in known:
            begin = _begin_of_last(search, steps)
            known[move.contacts] = survives_hand_over(search.scene, begin, (last, step), search.duration)
        return known[move.contacts]

    return survives


def _names(move: Move) -> tuple[str, ...]:
    """Name the contacts that touch between the ends of a path."""
    return tuple(feature_pair(name) for name in move.contacts if name not in AWAY_NAMES)
