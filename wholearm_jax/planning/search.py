r"""Search from a configuration to a goal, over the moves between contact formations.

Nodes are configurations; moves lead from one to the next (`moves_from`). A move may be left at its path's end, where a
coordinate of the goal has its value, or at a few places between, from where others may begin. The search is best-first
by the number of phases and an estimate of those still needed, and drops moves whose margin is below the floor. Plans
that it finds are traced anew, at full resolution, and ranked by their certificate: the least upper bound of their
phases, then the number of phases.
"""

import heapq
import itertools
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Float

from wholearm_jax.core import CachedJit, Status, as_device_array, require_x64
from wholearm_jax.margin import margin_upper_bound
from wholearm_jax.model import ANGLE_COORDINATES, COORDINATES, Phase, Scene, contact_formation, path_target, rigid_body
from wholearm_jax.phases import describe_end, trace
from wholearm_jax.planning.goal import Goal, make_goal
from wholearm_jax.planning.moves import Move, moves_from
from wholearm_jax.planning.successors import touching_contacts

phase_bound = CachedJit(margin_upper_bound)

STOPS = (1 / 3, 2 / 3)  # fractions of a path at which other moves may begin
MERGE_TOL = 1e-5  # configurations closer than this, in object radii and radians, are one node
TYPICAL_SHIFT, TYPICAL_TURN = 0.5, 0.5  # of one move [object radii, rad], for the estimate of phases to come


@dataclass(frozen=True)
class Step:
    """One phase of a plan: a move, and the place at which it is left."""

    contacts: tuple[str, ...]
    toward: str
    until: tuple[str, float] | None  # a coordinate and its value; None: the path's end
    end: np.ndarray  # (5,) `z` (SI)
    margin: float  # [N], least on the way, at rest


@dataclass(frozen=True)
class Plan:
    """Phases that lead to the goal, as a scene that `optimise` takes as it is."""

    scene: Scene
    steps: tuple[Step, ...]
    begins: tuple[np.ndarray, ...]  # `z` (SI) where each phase begins, and
    ends: tuple[np.ndarray, ...]  # ends
    reasons: tuple[str, ...]  # why each path ends
    bounds: tuple[float, ...]  # upper bound of each phase's margin [N]

    @property
    def bound(self) -> float:
        """The plan's certificate: no torque gives a larger margin."""
        return min(self.bounds)


@dataclass(frozen=True)
class PlanningResult:
    """The best plans, or what stands in the way."""

    start: np.ndarray  # (5,) `z` (SI)
    goal: Goal
    plans: tuple[Plan, ...]  # best first
    nearest: Plan | None  # where there is none: to the configuration nearest to the goal
    reason: str  # why there is no plan, empty if there is one
    nodes: int  # configurations that were expanded
    moves: int  # paths that were traced

    @property
    def found(self) -> bool:
        """Whether there is a plan."""
        return bool(self.plans)


@dataclass
class _Search:
    """State of a search."""

    scene: Scene
    start: np.ndarray
    goal: Goal
    floor: float
    radius: float
    max_phases: int
    queue: list[Any] = field(default_factory=list)
    visited: set[tuple[int, ...]] = field(default_factory=set)
    order: Any = field(default_factory=itertools.count)
    nearest: tuple[float, tuple[Step, ...]] = (np.inf, ())
    nodes: int = 0
    moves: int = 0


def plan(
    scene: Scene,
    goal: Mapping[str, float] | None = None,
    *,
    by: Mapping[str, float] | None = None,
    tolerance: Mapping[str, float] | None = None,
    margin: float = 0.0,
    count: int = 3,
    max_phases: int = 5,
    time_limit: float = 60.0,
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
        time_limit: seconds of search, compiling left out, after which it ends with what it has.
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
    begin = time.monotonic()
    start, touching = _start(scene)
    search = _Search(
        scene=scene,
        start=start,
        goal=make_goal(start, goal, by=by, tolerance=tolerance),
        floor=margin,
        radius=float(np.hypot(*np.asarray(rigid_body(scene.object).vertices).T).max()),
        max_phases=max_phases,
    )
    _push(search, start, (), touching)
    plans: list[Plan] = []
    out_of_time = False
    while search.queue and len(plans) < count:
        _, _, z, steps, names = heapq.heappop(search.queue)
        if steps and search.goal.is_reached(z):
            verified = make_plan(scene, start, steps, duration, search.goal)
            if verified is not None and verified.bound > margin:
                plans.append(verified)
            continue
        out_of_time = time.monotonic() - begin > time_limit
        if len(steps) < max_phases and not out_of_time:
            _expand(search, z, steps, names)
            if search.nodes == 1:  # the first expansion compiles: that is no time of the search
                begin = time.monotonic()
        if callback is not None:
            callback(search.nodes, search.nearest[0])
    plans.sort(key=lambda one: (-round(one.bound, 6), len(one.steps)))
    nearest, reason = None, ""
    if not plans:
        nearest = make_plan(scene, start, search.nearest[1], duration, None) if search.nearest[1] else None
        reason = _explain(search, nearest, out_of_time=out_of_time)
    return PlanningResult(start, search.goal, tuple(plans), nearest, reason, search.nodes, search.moves)


def _start(scene: Scene) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return the start and what touches there: of the first phase's path if there is one, else of the start itself."""
    first = eqx.tree_at(lambda s: s.phases, scene, scene.phases[:1])
    z = np.asarray(trace(first)[0].begin if scene.phases else scene.start)
    return z, touching_contacts(scene, as_device_array(z))


def _push(search: _Search, z: np.ndarray, steps: tuple[Step, ...], touching: tuple[str, ...] | None) -> None:
    """Add a configuration to the queue unless it is there already."""
    unit = np.array([search.radius, search.radius, 1, 1, 1])
    key = tuple(np.round(z / unit / MERGE_TOL).astype(int).tolist())
    if key in search.visited:
        return
    search.visited.add(key)
    distance = _phases_to_go(search, z)
    if distance < search.nearest[0] - 1e-9:
        search.nearest = (distance, steps)
    heapq.heappush(search.queue, (len(steps) + distance, next(search.order), z, steps, touching))


def _phases_to_go(search: _Search, z: np.ndarray) -> float:
    """Estimate how many moves lead from a configuration to the goal; 0 within its tolerances."""
    sizes = [
        TYPICAL_TURN if name in ANGLE_COORDINATES else TYPICAL_SHIFT * search.radius for name in search.goal.values
    ]
    tolerances = np.array([search.goal.tolerance[name] for name in search.goal.values])
    return float((np.maximum(search.goal.distance(z) - tolerances, 0.0) / sizes).sum())


def _expand(search: _Search, z: np.ndarray, steps: tuple[Step, ...], touching) -> None:
    """Trace all moves from a configuration and push the places at which they may be left."""
    moves = moves_from(search.scene, as_device_array(z), touching)
    search.nodes += 1
    search.moves += len(moves)
    previous = steps[-1].contacts if steps else None
    for move in moves:
        if move.contacts == previous:  # on or back along the same path: no new move
            continue
        for step, is_end in _stops(search, move):
            if step.margin > search.floor:
                _push(search, step.end, (*steps, step), None if is_end else _names(move))


def _names(move: Move) -> tuple[str, ...]:
    """Name the contacts that touch between the ends of a path."""
    return tuple(name.partition(" ")[0] for name in move.contacts)


def _stops(search: _Search, move: Move):
    """Yield the places at which a move may be left: its end, the goal's coordinates, and a few between."""
    lowest = np.minimum.accumulate(move.margins)
    last = len(move.places) - 1
    yield Step(move.contacts, move.toward, None, move.places[last], float(lowest[last])), True
    for name, value in search.goal.values.items():
        yield from _crossings(move, lowest, name, value)
    displacement = np.abs(move.places[last] - move.places[0]) / np.array([search.radius, search.radius, 1, 1, 1])
    name = COORDINATES[int(np.argmax(displacement))]
    for fraction in STOPS:
        value = float(move.places[round(fraction * last)][COORDINATES.index(name)])
        yield from itertools.islice(_crossings(move, lowest, name, value), 1)


def _crossings(move: Move, lowest: np.ndarray, name: str, value: float):
    """Yield the places of a move at which a coordinate first has a value, strictly between its ends."""
    row = COORDINATES.index(name)
    off = move.places[:, row] - value
    crossed = np.flatnonzero((off[:-1] != 0) & (off[:-1] * off[1:] <= 0))
    if len(crossed) and crossed[0] + 1 < len(off):
        k = int(crossed[0])
        fraction = off[k] / (off[k] - off[k + 1])
        z = move.places[k] + fraction * (move.places[k + 1] - move.places[k])
        if 0 < k + fraction < len(off) - 1 - 1e-6:
            yield Step(move.contacts, move.toward, (name, value), z, float(lowest[k + 1])), False


def make_plan(
    scene: Scene, start: Float[np.ndarray, "5"], steps: tuple[Step, ...], duration: float, goal: Goal | None
) -> Plan | None:
    """Trace steps as a plan at full resolution; None where a phase cannot be traced, or the goal is missed."""
    phases = tuple(
        Phase(
            f"{k + 1}: {' '.join(step.contacts)}",
            contact_formation(step.contacts),
            path_target(step.toward, dict([step.until]) if step.until else None),
            as_device_array(duration),
        )
        for k, step in enumerate(steps)
    )
    planned = eqx.tree_at(lambda s: (s.start, s.phases), scene, (as_device_array(start), phases))
    traced = trace(planned)
    if any(int(one.dynamics.status) != Status.OK or bool(one.dynamics.ends_at_obstacle) for one in traced):
        return None
    ends = tuple(np.asarray(one.end) for one in traced)
    if goal is not None and not goal.is_reached(ends[-1]):
        return None
    reasons = tuple(describe_end(planned, phase, one) for phase, one in zip(phases, traced, strict=True))
    values = tuple(
        float(phase_bound(one.dynamics, phase.duration).value) for phase, one in zip(phases, traced, strict=True)
    )
    return Plan(planned, steps, tuple(np.asarray(one.begin) for one in traced), ends, reasons, values)


def _explain(search: _Search, nearest: Plan | None, *, out_of_time: bool) -> str:
    """Say in words how near the search came, and what stands in the way there."""
    z = nearest.ends[-1] if nearest is not None else search.start
    missing = search.goal.distance(z)
    parts = [
        f"{name} is off by {np.degrees(d):.3g} deg"
        if name in ANGLE_COORDINATES
        else f"{name} is off by {1e3 * d:.3g} mm"
        for name, d in zip(search.goal.values, missing, strict=True)
        if d > search.goal.tolerance[name]
    ]
    limit = "the search's limit was reached" if out_of_time else "all moves were tried"
    obstructions = _obstructions(search, z)
    return f"no plan: {limit}; nearest: {', '.join(parts) or 'at the goal'}" + (
        f"; there {obstructions}" if obstructions else ""
    )


def _obstructions(search: _Search, z: np.ndarray) -> str:
    """Name what stops the moves from a configuration that lead toward the goal."""
    here, lines = _phases_to_go(search, z), []
    for move in moves_from(search.scene, as_device_array(z)):
        if _phases_to_go(search, move.places[1]) < here - 1e-6:
            lowest = float(move.margins.min())
            place = f"{' '.join(move.contacts)} toward {move.toward}"
            if lowest <= search.floor:
                lines.append(f"{place} has a margin of {lowest:.3g} N")
            else:
                lines.append(f"{place} ends too soon")
    return "; ".join(lines[:3]) or "nothing that touches leads nearer"
