"""Outlines: which vertices, taken in turn, make the object of a scene.

A polygon of the model is simple (no two edges touch but neighbours at their shared vertex), has an area, repeats no
vertex and runs anticlockwise, so that every edge's normal points into the object. Shapely judges it: its predicates are
exact, and its trees find what is close to what among many vertices.
"""

import numpy as np
import shapely
from jaxtyping import Float, Num

MIN_SEPARATION = 1e-9  # least distance between neighbouring vertices, and least breadth of a polygon, over its size


def find_defect(outlines: Num[np.ndarray, "polygons vertices 2"]) -> tuple[int, str] | None:
    """Return the number of the first outline that is no polygon, and why; None where all are polygons."""
    following = np.roll(outlines, -1, axis=1)
    size = np.ptp(outlines, axis=1).max(-1)
    repeated = np.hypot(*np.moveaxis(following - outlines, -1, 0)) <= MIN_SEPARATION * size[:, None]
    centred = outlines - outlines.mean(1, keepdims=True)
    thin = np.linalg.svd(centred, compute_uv=False)[:, 1] <= MIN_SEPARATION * size
    rings = shapely.linearrings(outlines)
    crossing = ~np.asarray(shapely.is_valid(shapely.polygons(rings)))
    bad = repeated.any(1) | thin | crossing | ~shapely.is_ccw(rings)
    if not bad.any():
        return None
    row = int(np.argmax(bad))
    if repeated[row].any():
        vertex = int(np.argmax(repeated[row]))
        return row, f"degenerate: vertices {vertex} and {(vertex + 1) % outlines.shape[1]} coincide"
    if thin[row]:
        return row, "degenerate: the vertices lie on one line, the polygon has no area"
    if crossing[row]:
        first, second = _first_crossing(outlines[row])
        return row, f"edges {first} and {second} cross or touch: the polygon intersects itself"
    return row, "clockwise: give the vertices anticlockwise"


def _first_crossing(outline: Float[np.ndarray, "vertices 2"]) -> tuple[int, int]:
    """Return the first two edges that touch without being neighbours, or that are neighbours and fold back."""
    count, edges = len(outline), _edges(outline)
    first, second = shapely.STRtree(edges).query(edges, predicate="intersects")
    first, second = (column[first < second] for column in (first, second))
    neighbours = (second == first + 1) | ((first == 0) & (second == count - 1))
    overlapping = shapely.length(shapely.intersection(edges[first], edges[second])) > 0
    pairs = np.stack([first, second], axis=1)[~neighbours | overlapping]
    one, other = min(pairs.tolist(), default=(0, 1))
    return one, other


def remains_simple(outline: Float[np.ndarray, "vertices 2"], moves: Float[np.ndarray, "vertices"]) -> bool:
    """Say whether a polygon surely remains simple when each vertex moves anywhere, by at most its part of `moves`.

    It does where no vertex can come to an edge that is not its own.
    """
    count, edges, points = len(outline), _edges(outline), np.asarray(shapely.points(outline))
    reach = np.maximum(moves, np.roll(moves, -1))
    vertex, edge = shapely.STRtree(edges).query(points, predicate="dwithin", distance=moves + reach.max())
    own = (vertex == edge) | (vertex == (edge + 1) % count)
    return bool(np.all(own | (shapely.distance(points[vertex], edges[edge]) > moves[vertex] + reach[edge])))


def _edges(outline: Float[np.ndarray, "vertices 2"]) -> np.ndarray:
    """Return the edges of an outline as an array of line strings."""
    return np.asarray(shapely.linestrings(np.stack([outline, np.roll(outline, -1, axis=0)], axis=1)))
