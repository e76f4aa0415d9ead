"""From a goal to a plan: the share of goals that is reached, how fast, and against a random search.

    python benchmarks/planning.py [--objects 2] [--seconds 5] [--quick] [--rates]

Objects are boxes, triangles, L shapes and random polygons, each at rest on an edge on those of three coplanar hands
whose fingers close on it without crossing; goals are slides by 20 and 40 mm, turns by 15 to 90 degrees, and both. Every
goal is planned for with rolling contacts, with regrasps besides, with sliding contacts alone, and by a random search (a
rapidly exploring random tree over the same moves, as in contact-mode-guided planning: X. Cheng, E. Huang, Y. Hou and
M. T. Mason, 2021), each for the same time. Prints and writes the shares (by goal on the best of the hands, too), the
margins, the times of plans that were found, what stands in the way of others, and moves a second; `--rates` measures
paths a second alone: all moves where the bundled plans' phases begin, traced, and as a search looks at them.
"""

import argparse
import statistics
import time
from collections import Counter, defaultdict
from functools import partial

import equinox as eqx
import matplotlib.pyplot as plt
import numpy as np
from measure import RESULTS, compare, save
from random_plans import random_object

import wholearm_jax as wa
from wholearm_jax.core import as_device_array
from wholearm_jax.files import bundled
from wholearm_jax.model import COORDINATES, object_radius, resting_configuration, rigid_body
from wholearm_jax.phases import describe_overlaps
from wholearm_jax.planning.goal import Goal, make_goal
from wholearm_jax.planning.moves import moves_from
from wholearm_jax.planning.path_choices import path_choices
from wholearm_jax.planning.plans import Step, contact_left, make_plan
from wholearm_jax.planning.successors import touching_contacts
from wholearm_jax.plotting.palette import CONTACT_COLOURS

HANDS = {"110 mm": (0.08, 0.11), "130 mm": (0.08, 0.13), "90 mm, close": (0.055, 0.09)}  # joints' x, lengths [m]
GOALS = {
    **{f"slide {d} mm": {"x": -1e-3 * d} for d in (20, 40)},
    **{f"turn {a} deg": {"phi": -np.radians(a)} for a in (15, 30, 45, 60)},
    "slide 20 mm, turn 30 deg": {"x": -0.02, "phi": -np.radians(30)},
}
FARTHER = {f"turn {a} deg": {"phi": -np.radians(a)} for a in (75, 90)}
FINGER = {"inertia": 2e-3, "viscous": 0.02, "dry": 0.01, "torque_limit": 1.0}
PLANNERS = {
    "regrasps": {"regrasp_cost": 1.0},
    "rolling": {},
    "sliding only": {"rolling": False},
    "random tree": None,
}
GOAL_SHARE = 0.2  # of the random tree's targets that are the goal


def objects(rng: np.random.Generator, count: int) -> list[tuple[str, dict]]:
    """Draw `count` objects of each kind."""
    drawn = []
    for _ in range(count):
        a, b = rng.uniform(0.04, 0.07), rng.uniform(0.03, 0.05)
        box = [[0, 0], [a, 0], [a, b], [0, b]]
        triangle = [[0, 0], [a, 0], [rng.uniform(0.3, 0.7) * a, b + 0.01]]
        angle = [[0, 0], [a, 0], [a, 0.4 * b], [0.4 * a, 0.4 * b], [0.4 * a, b], [0, b]]
        for kind, vertices in (("box", box), ("triangle", triangle), ("L", angle)):
            drawn.append((kind, {"vertices": vertices, "mass": 0.2, "friction": 0.1}))
        drawn.append(("polygon", random_object(rng)))
    return drawn


def at_rest(shape: dict, joint: float, length: float) -> wa.Scene | None:
    """Lay an object on the longest edge on which the fingers close on it without crossing; None: there is none."""
    fingers = {f"finger{k}": FINGER | {"joint": [x, 0.0], "length": length} for k, x in ((1, joint), (2, -joint))}
    start = dict.fromkeys(("x", "y", "phi", "theta1", "theta2"), 0.0)
    phase = {
        "name": "",
        "contacts": ["palm:v0", "palm:v1", "finger1:v1", "finger2:v2"],
        "toward": "x-",
        "duration": 1.0,
    }
    data = {"title": "", "gravity": 9.81, "hand": fingers, "object": shape, "start": start, "phase": [phase]}
    scene = wa.parse(data)
    corners = np.asarray(rigid_body(scene.object).vertices)[: len(shape["vertices"])]
    edges = np.argsort([-np.hypot(*(np.roll(corners, -1, 0) - corners)[k]) for k in range(len(corners))])
    for edge in edges:
        try:
            z = resting_configuration(scene.object, scene.hand, int(edge), 0.01)
        except ValueError:
            continue
        if not describe_overlaps(scene, as_device_array(z)):
            return eqx.tree_at(lambda s: (s.start, s.phases), scene, (as_device_array(z), ()))
    return None


def first_crossing(places: np.ndarray, name: str, value: float) -> tuple[int, np.ndarray] | None:
    """Where along a path a coordinate first has a value: in which interval, and the place; None: it has not.

    A path that begins with that value has it only once it returns.
    """
    off = places[:, COORDINATES.index(name)] - value
    crossed = np.flatnonzero((off[:-1] != 0) & (off[:-1] * off[1:] <= 0))
    if not len(crossed):
        return None
    k = int(crossed[0])
    return k, places[k] + off[k] / (off[k] - off[k + 1]) * (places[k + 1] - places[k])


def random_tree(scene: wa.Scene, by: dict, seconds: float, seed: int, max_phases: int = 5):
    """Grow a random tree over the planner's moves for so many seconds; the best plan that it comes upon, or None."""
    rng, start = np.random.default_rng(seed), np.asarray(scene.start)
    goal: Goal = make_goal(start, by=by)
    radius = object_radius(scene.object)
    nodes = [(start, (), touching_contacts(scene, as_device_array(start)))]
    best, end = None, time.monotonic() + seconds
    target_of_goal = start.copy()
    for name, value in goal.values.items():
        target_of_goal[COORDINATES.index(name)] = value
    while time.monotonic() < end:
        target = target_of_goal[[0, 2]] if rng.random() < GOAL_SHARE else rng.uniform([-0.05, -np.pi], [0.05, np.pi])
        apart = [np.hypot((z[0] - target[0]) / radius, z[2] - target[1]) for z, _, _ in nodes]
        z, steps, names = nodes[int(np.argmin(apart))] if rng.random() < 0.5 else nodes[rng.integers(len(nodes))]
        if len(steps) == max_phases:
            continue
        every = moves_from(scene, as_device_array(z), names, left=contact_left(steps))
        moves = [move for move in every if move.margins[0] > 0]
        if not moves:
            continue
        move = moves[rng.integers(len(moves))]
        held = np.flatnonzero(np.minimum.accumulate(move.margins) > 0)[-1]
        for name, value in goal.values.items():  # ends on the goal where the move passes it
            passed = first_crossing(move.places[: held + 1], name, value)
            if passed is not None:
                last = Step(move.contacts, move.toward, (name, value), passed[1], 0.0)
                found = make_plan(scene, start, (*steps, last), 1.0, goal)
                if found is not None and found.bound > 0 and (best is None or found.bound > best.bound):
                    best = found
        if held == len(move.places) - 1:
            step = Step(move.contacts, move.toward, None, move.places[-1], 0.0, leaves=move.leaves)
            nodes.append((move.places[-1], (*steps, step), None))
    return best


def measure(count: int, seconds: float, seed: int) -> dict:
    """Plan for every goal of every object on every hand by every planner."""
    rows, paths, spent = [], 0, 0.0
    rng = np.random.default_rng(seed)
    drawn = objects(rng, count)
    warm = at_rest(drawn[0][1], *HANDS["110 mm"])
    if warm is not None:
        wa.plan(warm, by=GOALS["slide 20 mm"], max_nodes=2)  # compiles
    for number, (kind, shape) in enumerate(drawn):
        for hand, (joint, length) in HANDS.items():
            scene = at_rest(shape, joint, length)
            if scene is None:
                continue
            for goal, by in (GOALS | FARTHER).items():
                for planner, options in PLANNERS.items():
                    begun = time.perf_counter()
                    if options is None:
                        found = random_tree(scene, by, seconds, seed)
                        bound, reason = (None, "") if found is None else (found.bound, "")
                    else:
                        result = wa.plan(scene, by=by, count=1, time_limit=seconds, **options)
                        bound, reason = (result.plans[0].bound if result.found else None), result.reason
                        paths += result.moves
                        spent += time.perf_counter() - begun
                    rows.append(
                        {
                            "object": number,
                            "kind": kind,
                            "hand": hand,
                            "goal": goal,
                            "planner": planner,
                            "bound": bound,
                            "seconds": time.perf_counter() - begun,
                            "reason": reason,
                        }
                    )
            print(f"{kind}, {hand}: done", flush=True)
    return {"rows": rows, "paths_a_second": paths / max(spent, 1e-9), "time_limit": seconds}


def path_rates(repeats: int) -> list[dict]:
    """Time all moves where the phases of the bundled plans begin: all traced, and those alone that a search traces."""
    rows = []
    for name in bundled():
        scene = wa.load(name)
        for phase, traced in zip(scene.phases, wa.trace(scene), strict=True):
            touching = touching_contacts(scene, traced.begin)
            moves = len([*path_choices(scene, traced.begin, touching, rolling=True)])
            look = partial(moves_from, scene, traced.begin, touching)
            times = compare({"traced": look, "judged": partial(look, floor=0.0)}, repeats=repeats)
            rates = {f"{kind}_a_second": moves / time for kind, time in times.items()}
            rows.append({"scene": name, "phase": phase.name, "moves": moves, **rates})
    return rows


def report_rates(rows: list[dict]) -> None:
    """Print how many moves a second are traced, and judged as a search does: most before they are traced."""
    for key, word in (("traced_a_second", "traced"), ("judged_a_second", "judged")):
        rates = [row[key] for row in rows]
        print(f"moves {word}: {statistics.median(rates):.0f} a second in the median, {min(rates):.0f} at least")


def shares(rows: list[dict], key: str) -> dict[str, dict[str, float]]:
    """Share of goals that each planner reaches, by `key`."""
    groups: dict = defaultdict(lambda: defaultdict(list))
    for row in rows:
        groups[row[key]][row["planner"]].append(row["bound"] is not None)
    return {name: {p: sum(hits) / len(hits) for p, hits in group.items()} for name, group in groups.items()}


def obstructions(rows: list[dict]) -> Counter:
    """Count what stops the paths that lead nearer to goals that are not reached with regrasps."""
    kinds = {"has a margin": "negative margins", "obstacle": "obstacles", "leads nearer": "there are none"}
    failed = [row["reason"] for row in rows if row["planner"] == "regrasps" and row["bound"] is None]
    return Counter(
        " and ".join(kind for phrase, kind in kinds.items() if phrase in reason) or "end too soon" for reason in failed
    )


def best_hands(rows: list[dict]) -> list[dict]:
    """Keep one row for each object, goal and planner: of a hand on which the goal is reached, if there is one."""
    best: dict = {}
    for row in rows:
        key = row["object"], row["goal"], row["planner"]
        if key not in best or best[key]["bound"] is None:
            best[key] = row
    return [*best.values()]


def print_shares(rows: list[dict], key: str) -> None:
    """Print a line for each value of `key`."""
    for name, group in shares(rows, key).items():
        print(f"{name:26s}" + "".join(f"{100 * group[p]:13.0f}%" for p in PLANNERS))


def report(found: dict) -> None:
    """Print tables of shares, margins where two planners found a plan, and times."""
    rows = found["rows"]
    for key in ("kind", "hand", "goal"):
        print(f"\n{key:26s}" + "".join(f"{p:>14s}" for p in PLANNERS))
        print_shares(rows, key)
    print("\non the best of an object's hands")
    print_shares(best_hands(rows), "goal")
    print("\nwhere there is no plan with regrasps, the paths that lead nearer")
    for reason, count in obstructions(rows).most_common():
        print(f"{count:4d} {reason}")
    by_planner = {p: [row for row in rows if row["planner"] == p] for p in PLANNERS}
    pairs = [
        (a["bound"], b["bound"])
        for a, b in zip(by_planner["rolling"], by_planner["random tree"], strict=True)
        if a["bound"] and b["bound"]
    ]
    if pairs:
        print(
            f"\nbound over the random tree's, median of {len(pairs)}: {statistics.median(a / b for a, b in pairs):.2f}"
        )
    times = [row["seconds"] for row in by_planner["rolling"] if row["bound"]]
    if times:
        print(
            f"plans found: {statistics.median(times):.2f} s in the median; {found['paths_a_second']:.0f} moves a second"
        )


def draw(rows: list[dict]) -> plt.Figure:
    """Shares of goals reached by kind of object, hand and goal."""
    figure, axes = plt.subplots(1, 3, figsize=(10.5, 3.4), sharey=True, layout="constrained", width_ratios=(4, 3, 9))
    for ax, key in zip(axes, ("kind", "hand", "goal"), strict=True):
        table = shares(rows, key)
        for k, planner in enumerate(PLANNERS):
            at = np.arange(len(table)) + 0.21 * (k - 1.5)
            ax.bar(
                at, [100 * group[planner] for group in table.values()], 0.2, color=CONTACT_COLOURS[1 + k], label=planner
            )
        ax.set_xticks(range(len(table)), list(table), rotation=30, ha="right", fontsize=8)
        ax.set_title(key, fontsize=9)
        ax.spines[["top", "right"]].set_visible(False)
    axes[0].set_ylabel("goals reached [%]")
    axes[-1].legend(frameon=False, fontsize=8)
    return figure


def main() -> None:
    wa.configure()
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--objects", type=int, default=2, help="of each kind")
    parser.add_argument("--seconds", type=float, default=5.0, help="for each goal and planner")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--quick", action="store_true", help="one hand, two goals, half a second; nothing is written")
    parser.add_argument("--rates", action="store_true", help="paths a second, nothing else")
    given = parser.parse_args()
    if given.rates:
        rows = path_rates(repeats=1 if given.quick else 25)
        report_rates(rows)
        if not given.quick:
            save("planning_rates", {"rows": rows})
        return
    if given.quick:
        for table, kept in ((HANDS, ["110 mm"]), (GOALS, ["slide 20 mm", "turn 15 deg"]), (FARTHER, [])):
            for name in {*table} - {*kept}:
                del table[name]
    found = measure(1 if given.quick else given.objects, 0.5 if given.quick else given.seconds, given.seed)
    report(found)
    if not given.quick:
        save("planning", found)
        draw(found["rows"]).savefig(RESULTS / "planning.svg", bbox_inches="tight")


if __name__ == "__main__":
    main()
