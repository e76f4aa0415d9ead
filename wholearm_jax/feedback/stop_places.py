"""Where on a phase's path parts of other shape meet the contact that ends it: before the nominal stop, or beyond it."""

from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from wholearm_jax.core import Status
from wholearm_jax.feedback.path_table import PathTable
from wholearm_jax.model import Scene, object_radius, remains_simple
from wholearm_jax.phases import TracedPhase

SHAPES = 12  # parts that are drawn to be held
SHAPES_AT_STOPS = 64  # parts that are drawn to see where they stop
RELATIVE_SHAPE = 0.01  # half width of a vertex's coordinates unless given [object radii]
FARTHEST = 0.3  # distance from the nominal stop that is looked at, at most [path lengths]


class StopPlaces(NamedTuple):
    """How far from the nominal stop that of other parts lies, at most [rad]."""

    before: float
    beyond: float


def draw_shapes(scenes: list[Scene], shape: float | None, seed: int = 0, count: int = SHAPES) -> list[Scene]:
    """Draw `count` objects whose vertices are off by up to `shape` [m] in x and y, each else as one of `scenes`.

    Raises:
        ValueError: Where edges of such an object could cross.
    """
    scene = scenes[0]
    outline = np.asarray(scene.object.vertices)[: int(scene.object.count)]
    if shape is None:
        shape = RELATIVE_SHAPE * object_radius(scene.object)
    if shape == 0:
        return []
    if not remains_simple(outline, np.full(len(outline), np.sqrt(2) * shape)):
        raise ValueError(f"shape {shape:.3g} m: too much, edges of the polygon could cross")
    random, drawn = np.random.default_rng(seed), []
    for k in range(count):
        vertices = np.array(scene.object.vertices)
        vertices[: len(outline)] += random.uniform(-shape, shape, outline.shape)
        vertices[len(outline) :] = vertices[len(outline) - 1]
        drawn.append(eqx.tree_at(lambda s: s.object.vertices, scenes[-1 - k % len(scenes)], vertices))
    return drawn


def stop_places(tables: list[PathTable], drawn: list[tuple[TracedPhase, ...]]) -> list[StopPlaces]:
    """Return the range of each phase's stops, by those of the drawn objects' paths that can be traced."""
    found = []
    for k, table in enumerate(tables):
        ends = [np.asarray(paths[k].end)[3:] for paths in drawn if has_paths(paths[: k + 1])]
        after = np.array([_place(table, end) - table.s[-1] for end in ends])
        farthest = FARTHEST * table.s[-1]
        found.append(StopPlaces(*(float(np.clip(side, 0.0, farthest).max(initial=0.0)) for side in (-after, after))))
    return found


def has_paths(paths: tuple[TracedPhase, ...]) -> bool:
    """Say whether all of an object's paths can be traced."""
    return all(int(path.dynamics.status) == Status.OK for path in paths)


def _place(table: PathTable, theta: Float[np.ndarray, "2"]) -> float:
    """Project joint angles onto the curve, straight on beyond its ends."""
    near = int(np.argmin(((table.theta - theta) ** 2).sum(1)))
    return float(table.s[near] + table.tangent[near] @ (theta - table.theta[near]))
