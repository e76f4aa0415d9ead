"""Plans of several formations on random polygons that follow one another without a stop.

    python benchmarks/flying_plans.py --count 4 --phases 3 --out DIR

From a random grasp (`random_plans`) every admissible formation is followed to its end
(`wholearm_jax.planning.successors`),
and from there every formation whose impact would push, not pull, and pass the speed on. Chains of real length whose
formations torques can hold are kept.
"""

import argparse
import itertools
from collections.abc import Iterator
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from layered_scenes import layered
from random_plans import _grasps, random_object, write

import wholearm_jax as wa
from wholearm_jax.files import to_dict
from wholearm_jax.model import Arrival, Phase, contact_formation, path_target
from wholearm_jax.planning import Successor, exit_velocity, successor_formations

SHORTEST, LEAST_BOUND, SLOWED = 0.2, 0.2, 0.2  # path [object radii], bound [N], speed after an impact over that before


def flying_plans(count: int, seed: int = 0, *, phases: int = 3, pace: float = 0.4) -> tuple[wa.Scene, ...]:
    """The first `count` plans of `phases` phases, `pace` seconds for each object radius; no two share a polygon."""
    return tuple(itertools.islice(plans(np.random.default_rng(seed), phases, pace), count))


def plans(rng: np.random.Generator, phases: int, pace: float) -> Iterator[wa.Scene]:
    """One plan after another, without end."""
    hand = to_dict(layered("heptagon"))["hand"]
    for number in itertools.count():
        shape = random_object(rng)
        found = (plan for grasp in _grasps(rng, shape["vertices"], hand) for plan in _from(grasp, shape, hand, phases))
        chain = next(found, None)
        if chain is not None:
            scene, taken = chain
            rows = tuple(_phase(k, way, pace * way.length, k == phases - 1) for k, way in enumerate(taken))
            title = f"random polygon {number}, {phases} formations without a stop"
            yield wa.Scene(title, scene.gravity, scene.hand, scene.object, scene.start, rows)


def _from(grasp, shape, hand, phases):
    """Chains from one grasp, with the scene they start in."""
    start, contacts = grasp
    row = {"name": "first", "contacts": list(contacts), "toward": "x-", "duration": 1.0}
    scene = wa.parse({"title": "", "gravity": 9.81, "hand": hand, "object": shape, "start": start, "phase": [row]})
    (traced,) = wa.trace(scene)
    if int(traced.dynamics.status) != 0:
        return
    z = traced.begin
    scene = eqx.tree_at(lambda s: s.start, scene, z)
    for chain in chains(scene, z, phases):
        yield scene, chain


def chains(scene: wa.Scene, z, depth: int, z_dot=None) -> Iterator[tuple[Successor, ...]]:
    """Ways from `z` that lead on, each entered at the speed with which the one before it ends."""
    for way in successor_formations(scene, z, z_dot):
        holds = way.status is wa.Status.OK and way.bound > LEAST_BOUND and way.length > SHORTEST
        if not holds or (z_dot is not None and (way.pulls or way.speed < SLOWED)):
            continue
        if depth == 1:
            yield (way,)
        else:
            yield from ((way, *rest) for rest in chains(scene, way.end, depth - 1, exit_velocity(way.traced.dynamics)))


def _phase(number: int, way: Successor, duration: float, last: bool) -> Phase:
    arrive = Arrival.AT_REST if last else Arrival.MOVING
    return Phase(
        f"phase {number}", contact_formation(way.contacts), path_target(way.toward), jnp.asarray(duration), arrive
    )


def main() -> None:
    wa.configure()
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=4)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--phases", type=int, default=3)
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    scenes = flying_plans(given.count, given.seed, phases=given.phases)
    for scene in scenes:
        print(scene.title, [(p.formation.names, p.arrive.name) for p in scene.phases])
    if given.out is not None:
        write(scenes, given.out)


if __name__ == "__main__":
    main()
