"""The planner against an exhaustive search in finer steps: does it find a plan wherever there is one, and the best?

    python benchmarks/exhaustive_planning.py [--objects 1] [--depth 4] [--places 8] [--seconds 5] [--again]

The exhaustive search goes through all moves breadth first, from many places along each path, without a goal, an
estimate, a floor or patience: one search of an object on a hand answers all goals of `planning.py`. Configurations of
the same contacts within a cell (in object radii and radians) are one, the one with the largest margin on its way. It
shares the tracing of paths and the certificate of a plan with the planner, and nothing of its search.
"""

import argparse
import heapq
import itertools
import json
import time
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import matplotlib.pyplot as plt
import numpy as np
from measure import RESULTS, save
from planning import GOALS, HANDS, at_rest, first_crossing, objects

import wholearm_jax as wa
from wholearm_jax.core import as_device_array
from wholearm_jax.model import COORDINATES, object_radius
from wholearm_jax.planning.goal import Goal, make_goal
from wholearm_jax.planning.moves import Move, moves_from
from wholearm_jax.planning.plans import Plan, Step, contact_left, make_plan
from wholearm_jax.planning.successors import touching_contacts

CANDIDATES = 200  # formations of plans that are kept for each goal, those of the largest margins at rest
TRIES = 30  # of these that are traced at full resolution
DEFICIT = 0.02  # share of the reference's certificate by which the planner's may be smaller


class Node(NamedTuple):
    """A configuration that the exhaustive search has reached."""

    margin: float  # [N], least on the way, at rest
    z: np.ndarray
    steps: tuple[Step, ...]
    touching: tuple[str, ...] | None  # None: not known yet


class Reached(NamedTuple):
    """What an exhaustive search has found: for each goal, ways to it by the formations that they use."""

    ways: dict[str, dict[tuple, Node]]
    nodes: int
    paths: int


def explore(scene: wa.Scene, goals: dict[str, Goal], depth: int, places: int, cells: tuple[float, ...]) -> Reached:
    """Go through all moves of up to `depth` phases."""
    radius = object_radius(scene.object)
    unit, start = np.array([radius, radius, 1, 1, 1]), np.asarray(scene.start)
    ways: dict[str, dict[tuple, Node]] = {name: {} for name in goals}
    level, nodes, paths = [Node(np.inf, start, (), touching_contacts(scene, as_device_array(start)))], 0, 0

    def expand(node: Node) -> tuple[Move, ...]:
        return moves_from(scene, as_device_array(node.z), node.touching, left=contact_left(node.steps))

    with ThreadPoolExecutor(2) as threads:
        for number in range(depth):
            following: dict[tuple, Node] = {}
            for node, moves in zip(level, threads.map(expand, level), strict=True):
                nodes, paths = nodes + 1, paths + len(moves)
                for move in moves:
                    for name, goal in goals.items():
                        _keep_ways(ways[name], node, move, goal)
                    if number + 1 < depth:
                        _keep_places(following, node, move, places, cells[number] * unit)
            level = [*following.values()]
            print(f"    after {number + 1} phases: {paths} paths, {len(level)} places to go on from", flush=True)
    return Reached(ways, nodes, paths)


def _keep_ways(ways: dict[tuple, Node], node: Node, move: Move, goal: Goal) -> None:
    """Keep where a move first reaches a goal, at its end or where a coordinate has its value."""
    lowest = np.minimum(np.minimum.accumulate(move.margins), node.margin)
    last = len(move.places) - 1
    ends = [(None, move.places[last], lowest[last])]
    for name, value in goal.values.items():
        passed = first_crossing(move.places, name, value)
        if passed is not None:
            ends.append(((name, value), passed[1], lowest[passed[0] + 1]))
    for until, z, margin in ends:
        if margin > 0 and goal.is_reached(z):
            steps = (*node.steps, Step(move.contacts, move.toward, until, z, float(margin)))
            key = tuple((step.contacts, step.toward) for step in steps)
            if key not in ways or ways[key].margin < margin:
                ways[key] = Node(float(margin), z, steps, None)
    if len(ways) > 2 * CANDIDATES:
        kept = heapq.nlargest(CANDIDATES, ways.items(), key=lambda item: item[1].margin)
        ways.clear()
        ways.update(kept)


def _keep_places(following: dict[tuple, Node], node: Node, move: Move, places: int, cell: np.ndarray) -> None:
    """Keep the places of a move from which others may begin, as long as it can be held so far."""
    lowest = np.minimum(np.minimum.accumulate(move.margins), node.margin)
    last = len(move.places) - 1
    leading = int(np.argmax(np.abs(move.places[last] - move.places[0]) / cell))
    run = move.places[:, leading]
    for at in np.linspace(0, last, places + 1).round().astype(int)[1:]:
        z = move.places[at]
        if not lowest[at] > 0 or np.any((run[1:at] - z[leading]) * (run[0] - z[leading]) <= 0):
            return  # lost, or the coordinate that names the place has had its value before
        until = None if at == last else (COORDINATES[leading], float(z[leading]))
        touching = None if at == last else tuple(name.removesuffix(" rolling") for name in move.contacts)
        leaves = move.leaves if at == last else None
        key = (touching and frozenset(touching), leaves, *np.round(z / cell).astype(int).tolist())
        if key not in following or following[key].margin < lowest[at]:
            step = Step(move.contacts, move.toward, until, z, float(lowest[at]), leaves=leaves)
            following[key] = Node(float(lowest[at]), z, (*node.steps, step), touching)


def best_plan(scene: wa.Scene, ways: dict[tuple, Node], goal: Goal) -> Plan | None:
    """Trace ways to a goal at full resolution, those with the largest margins at rest first; the best plan."""
    best = None
    ordered = sorted(ways.values(), key=lambda way: -way.margin)
    for way in itertools.islice(ordered, TRIES):
        if best is not None and way.margin < best.bound:
            break  # the planner, whose search goes by margins at rest, leaves these out, too
        found = make_plan(scene, np.asarray(scene.start), way.steps, 1.0, goal)
        if found is not None and found.bound > 0 and (best is None or found.bound > best.bound):
            best = found
    return best


def search_all(kind: str, hand: str, scene: wa.Scene, options: argparse.Namespace) -> list[dict]:
    """The exhaustive search on one object and hand: a row for every goal."""
    start = np.asarray(scene.start)
    goals = {name: make_goal(start, by=by) for name, by in GOALS.items()}
    begun = time.perf_counter()
    reached = explore(scene, goals, options.depth, options.places, options.cells)
    cost = {"exhaustive_seconds": time.perf_counter() - begun, "exhaustive_paths": reached.paths}
    rows = []
    for name, goal in goals.items():
        reference = best_plan(scene, reached.ways[name], goal)
        row = {"kind": kind, "hand": hand, "goal": name, "exhaustive": reference and reference.bound, **cost}
        if reference is not None:
            row["best_ways"] = [(step.contacts, step.toward) for step in reference.steps]
        rows.append(row)
    return rows


def ask_planner(scene: wa.Scene, rows: list[dict], options: argparse.Namespace) -> None:
    """The planner on one object and hand, for the goals that the exhaustive search reaches: it adds to their rows."""
    for row in rows:
        row["planner"] = None
        if row["exhaustive"] is None:
            continue  # the planner is asked for what there is
        begun = time.perf_counter()
        result = wa.plan(scene, by=GOALS[row["goal"]], count=1, max_phases=options.depth, time_limit=options.seconds)
        row["planner"] = result.plans[0].bound if result.found else None
        row["planner_seconds"] = time.perf_counter() - begun
        name = f"  {row['kind']}, {row['hand']}, {row['goal']}"
        print(f"{name}: {row['exhaustive']}, planner {row['planner']}, {row['planner_seconds']:.1f} s", flush=True)


def report(rows: list[dict]) -> dict:
    """Count where the planner finds a plan that the exhaustive search has, and how good it is."""
    there = [row for row in rows if row["exhaustive"] is not None]
    both = [row for row in there if row["planner"] is not None]
    ratios = np.array([row["planner"] / row["exhaustive"] for row in both])
    found = {
        "goals": len(rows),
        "exhaustive": len(there),
        "planner": len(both),
        "within_2_percent": int((ratios > 1 - DEFICIT).sum()),
        "better_by_2_percent": int((ratios > 1 + DEFICIT).sum()),
        "planner_seconds_median": float(np.median([row["planner_seconds"] for row in there])) if there else np.nan,
        "ratio_quartiles": np.quantile(ratios, [0, 0.25, 0.5, 0.75, 1]).tolist() if len(both) else [],
    }
    print(", ".join(f"{name} {value}" for name, value in found.items()))
    return found


def draw(rows: list[dict]) -> plt.Figure:
    """The planner's certificates against those of the exhaustive search."""
    figure, ax = plt.subplots(figsize=(3.4, 3.2), layout="constrained")
    both = np.array([(row["exhaustive"], row["planner"]) for row in rows if row["exhaustive"] and row["planner"]])
    ax.loglog(*both.reshape(-1, 2).T, "o", ms=3, mfc="none")
    ends = [both.min(), both.max()] if len(both) else [0.1, 1.0]
    ax.loglog(ends, ends, color="0.6", lw=0.8)
    ax.set_xlabel("certificate of the exhaustive search's plan [N]", fontsize=8)
    ax.set_ylabel("of the planner's [N]", fontsize=8)
    ax.spines[["top", "right"]].set_visible(False)
    return figure


def main() -> None:
    wa.configure()
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--objects", type=int, default=1, help="of each kind")
    parser.add_argument("--depth", type=int, default=4, help="phases")
    parser.add_argument("--places", type=int, default=8, help="of each path at which others may begin")
    parser.add_argument(
        "--cells", type=float, nargs="+", default=(1e-3, 0.05, 0.1), help="sizes within which places are one, by depth"
    )
    parser.add_argument("--seconds", type=float, default=5.0, help="of the planner for each goal")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--hands", nargs="+", choices=HANDS, default=[*HANDS])
    parser.add_argument("--again", action="store_true", help="the planner alone, against what was found last")
    parser.add_argument("--quick", action="store_true", help="a box, two phases; nothing is written")
    options = parser.parse_args()
    drawn, hands = objects(np.random.default_rng(options.seed), options.objects), options.hands
    if options.quick:
        drawn, hands, options.depth, options.seconds = drawn[:1], hands[:1], 2, 0.5
    known = json.loads((RESULTS / "exhaustive_planning.json").read_text())["rows"] if options.again else []
    rows = []
    for kind, shape in drawn:
        for hand in hands:
            scene = at_rest(shape, *HANDS[hand])
            if scene is None:
                continue
            of_scene = known[len(rows) :][: len(GOALS)] if options.again else search_all(kind, hand, scene, options)
            ask_planner(scene, of_scene, options)
            rows += of_scene
    found = report(rows)
    if not options.quick:
        save("exhaustive_planning", {"summary": found, "rows": rows, "options": vars(options)})
        draw(rows).savefig(RESULTS / "exhaustive_planning.svg", bbox_inches="tight")


if __name__ == "__main__":
    main()
