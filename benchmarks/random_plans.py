"""Plans on random convex polygons for the bundled hand: slide over the palm, then flip over a vertex.

    python benchmarks/random_plans.py --count 12 --out DIR

A polygon is laid with one edge on the palm and both fingers are closed until each touches a vertex: four contacts,
whose path is followed either way. Where it ends a fifth contact is made; giving up one of the old four leaves the
next formation. A plan is kept when every phase can be traced, is of real length, and has a bound
(`wholearm_jax.bounds`) that is clearly positive: some torque can hold it everywhere. Whether one torque schedule can is
left to the optimisers.
"""

import argparse
import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from layered_scenes import layered

import wholearm_jax as wa
from wholearm_jax.files import to_dict
from wholearm_jax.phases import describe_end

VERTICES = (5, 9)  # least and most
RADIUS = (0.034, 0.048)  # of the circle that the vertices lie in or near [m]
DENT = 0.75  # the least distance of a vertex from the centre, in radii
FRICTION, MASS = (0.05, 0.2), (0.12, 0.3)  # [1], [kg]
SHARPEST = 0.25  # the least turn at a vertex [rad]
X, PHI = 0, 2  # coordinates
SLIDE, TURN = 0.25, 0.35  # the least travel [object radii] or turn [rad] of a phase that counts as real
LEAST_BOUND = 0.2  # [N], a tenth of the objects' weight
PLACES = 6  # places on the palm tried for each edge


def random_plans(count: int, seed: int = 0, *, phases: int = 2, duration: float = 1.0) -> tuple[wa.Scene, ...]:
    """The first `count` plans of `phases` (1 or 2) phases, each of `duration` [s]; no two share a polygon."""
    rng = np.random.default_rng(seed)
    return tuple(itertools.islice(plans(rng, phases, duration), count))


def write(scenes: tuple[wa.Scene, ...], folder: Path) -> None:
    """Every plan as `plan_NN.toml`."""
    folder.mkdir(parents=True, exist_ok=True)
    for number, scene in enumerate(scenes):
        wa.save(scene, folder / f"plan_{number:02d}.toml")


def plans(rng: np.random.Generator, phases: int, duration: float) -> Iterator[wa.Scene]:
    """One plan after another, without end."""
    hand = to_dict(layered("heptagon"))["hand"]
    for number in itertools.count():
        shape = random_object(rng)
        for start, contacts in _grasps(rng, shape["vertices"], hand):
            data = {"title": "", "gravity": 9.81, "hand": hand, "object": shape, "start": start, "phase": []}
            found = _plan(data, contacts, phases, duration)
            if found is not None:
                found["title"] = f"random polygon {number} with {len(shape['vertices'])} vertices"
                yield wa.parse(found)
                break


# --- polygons and grasps: plane geometry ------------------------------------------------------------------------------


def random_object(rng: np.random.Generator) -> dict[str, Any]:
    """The `object` of a scene file: a random polygon with its mass and friction."""
    return {
        "vertices": _polygon(rng).tolist(),
        "mass": round(rng.uniform(*MASS), 2),
        "friction": round(rng.uniform(*FRICTION), 2),
    }


def _polygon(rng: np.random.Generator) -> np.ndarray:
    """Anticlockwise vertices `(n, 2)` [m] of a convex polygon, to a tenth of a millimetre."""
    while True:
        count = rng.integers(VERTICES[0], VERTICES[1] + 1)
        angle = 2 * np.pi * (np.arange(count) + rng.uniform(-0.35, 0.35, count)) / count
        radius = rng.uniform(*RADIUS) * rng.uniform(DENT, 1.0, count)
        points = np.round(radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1), 4)
        edge = np.roll(points, -1, 0) - points
        heading = np.arctan2(edge[:, 1], edge[:, 0])
        turn = (heading - np.roll(heading, 1) + np.pi) % (2 * np.pi) - np.pi
        if turn.min() > SHARPEST:
            return points


def _centroid(points: np.ndarray) -> np.ndarray:
    after = np.roll(points, -1, 0)
    cross = points[:, 0] * after[:, 1] - points[:, 1] * after[:, 0]
    return (cross[:, None] * (points + after)).sum(0) / (3 * cross.sum())


def _grasps(rng: np.random.Generator, vertices, hand: dict[str, Any]) -> Iterator[tuple[dict[str, float], list[str]]]:
    """Starts with one edge on the palm and each finger on a vertex, as (start, contacts)."""
    points = np.asarray(vertices)
    points = points - _centroid(points)
    count = len(points)
    left, right = hand["finger2"]["joint"][0], hand["finger1"]["joint"][0]
    for k in rng.permutation(count):
        edge = points[(k + 1) % count] - points[k]
        phi = -np.arctan2(edge[1], edge[0])
        turned = points @ np.array([[np.cos(phi), np.sin(phi)], [-np.sin(phi), np.cos(phi)]])
        y = -turned[k, 1]
        palm = turned[[k, (k + 1) % count], 0]
        for x in rng.uniform(left - palm[0], right - palm[1], PLACES):
            fingers = [_closed(turned + np.array([x, y]), hand[f"finger{i}"], i) for i in (1, 2)]
            touched = [vertex for vertex, _ in fingers]
            if None in touched or set(touched) & {k, (k + 1) % count}:
                continue
            contacts = [f"palm:v{k}", f"palm:v{(k + 1) % count}"]
            contacts += [f"finger{i}:v{vertex}" for i, vertex in enumerate(touched, 1)]
            theta = [angle for _, angle in fingers]
            start = dict(zip(("x", "y", "phi", "theta1", "theta2"), (x, y, phi, *theta), strict=True))
            yield {name: round(float(value), 5) for name, value in start.items()}, contacts


def _closed(points: np.ndarray, finger: dict[str, Any], number: int) -> tuple[int | None, float]:
    """The vertex that a closing finger touches first, and the joint's angle; None where only its tip can touch."""
    away = points - finger["joint"]
    angle = np.arctan2(away[:, 1], away[:, 0])
    vertex = int(np.argmin(angle) if number == 1 else np.argmax(angle))
    reached = np.hypot(*away[vertex]) < finger["length"] and points[vertex, 1] > 0
    return (vertex if reached else None), float(angle[vertex])


# --- plans: paths that can be followed and held -----------------------------------------------------------------------


def _plan(data: dict[str, Any], contacts: list[str], phases: int, duration: float) -> dict[str, Any] | None:
    """A plan that begins with `contacts`, as `wholearm_jax.parse` takes it; None where none is found."""
    for toward, name in (("x-", "slide left"), ("x+", "slide right")):
        slide = {"name": name, "contacts": contacts, "toward": toward, "duration": duration}
        plan = data | {"phase": [slide]}
        end = _held_to(plan, X, SLIDE)
        if end is not None and phases == 2:
            plan = _flipped(plan, end)
        if end is not None and plan is not None:
            return plan
    return None


def _flipped(plan: dict[str, Any], end: str) -> dict[str, Any] | None:
    """The plan with a second phase, on the contact made at the first one's end and three of the old ones."""
    (slide,) = plan["phase"]
    made = end.removesuffix(" is made")
    if made == end:
        return None  # the first phase ended because a contact left its feature
    for dropped, toward in itertools.product(slide["contacts"], ("phi-", "phi+")):
        contacts = [c for c in slide["contacts"] if c != dropped] + [made]
        name = "flip right" if toward == "phi-" else "flip left"
        flip = slide | {"name": name, "contacts": contacts, "toward": toward}
        if _held_to(plan | {"phase": [slide, flip]}, PHI, TURN) is not None:
            return plan | {"phase": [slide, flip]}
    return None


def _held_to(plan: dict[str, Any], coordinate: int, least: float) -> str | None:
    """Why the last phase ends, if it can be followed and held over at least `plan_margin` of a coordinate; else
    None."""
    scene = wa.parse(plan)
    traced = wa.trace(scene)
    path, dynamics = traced[-1].path, traced[-1].dynamics
    if int(dynamics.status) or abs(float(path.end[coordinate] - path.start[coordinate])) < least:
        return None
    if not float(wa.bounds(scene, traced=traced)[-1].value) > LEAST_BOUND:
        return None
    return describe_end(scene, scene.phases[-1], traced[-1])


def main() -> None:
    wa.configure()
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--count", type=int, default=12)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--phases", type=int, choices=(1, 2), default=2)
    parser.add_argument("--out", type=Path, help="folder for the plans as scene files")
    chosen = parser.parse_args()
    scenes = random_plans(chosen.count, chosen.seed, phases=chosen.phases)
    for scene in scenes:
        tops = " ".join(f"{float(top.value):6.3f}" for top in wa.bounds(scene))
        print(f"{scene.title}: bounds [N] {tops}")
        for phase in scene.phases:
            print(f"    {phase.name:12s} {' '.join(phase.formation.names)}")
    if chosen.out:
        write(scenes, chosen.out)


if __name__ == "__main__":
    main()
