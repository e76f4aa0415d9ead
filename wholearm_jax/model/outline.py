"""Outline: which vertices, taken in turn, make the object of a scene.

A polygon of the model is simple (no two edges touch but neighbours at their shared vertex), has an area, repeats no
vertex and runs anticlockwise, so that every edge's normal points into the object.
"""

import itertools

import numpy as np
from jaxtyping import Bool, Float, Num

MIN_SEPARATION = 1e-9  # least distance between neighbouring vertices, and least breadth of a polygon, over its size


def find_defect(outlines: Num[np.ndarray, "polygons vertices 2"]) -> tuple[int, str] | None:
    """The first outline that is no polygon, and why; None where all are."""
    following = np.roll(outlines, -1, axis=1)
    size = np.ptp(outlines, axis=1).max(-1)
    repeated = np.hypot(*np.moveaxis(following - outlines, -1, 0)) <= MIN_SEPARATION * size[:, None]
    centred = outlines - outlines.mean(1, keepdims=True)
    thin = np.linalg.svd(centred, compute_uv=False)[:, 1] <= MIN_SEPARATION * size
    crossing = _crossing(centred)
    after = np.roll(centred, -1, axis=1)
    clockwise = (centred[..., 0] * after[..., 1] - centred[..., 1] * after[..., 0]).sum(1) < 0
    bad = repeated.any(1) | thin | (crossing[:, 0] >= 0) | clockwise
    if not bad.any():
        return None
    row = int(np.argmax(bad))
    if repeated[row].any():
        vertex = int(np.argmax(repeated[row]))
        return row, f"degenerate: vertices {vertex} and {(vertex + 1) % outlines.shape[1]} coincide"
    if thin[row]:
        return row, "degenerate: the vertices lie on one line, the polygon has no area"
    if crossing[row, 0] >= 0:
        return row, "edges {} and {} cross or touch: the polygon intersects itself".format(*crossing[row])
    return row, "clockwise: give the vertices anticlockwise"


def remains_simple(outline: Float[np.ndarray, "vertices 2"], moves: Float[np.ndarray, "vertices"]) -> bool:
    """Whether a polygon surely remains one when each vertex moves anywhere, by at most its part of `moves`: then no
    vertex can come to an edge that is not its own."""
    after, reach = np.roll(outline, -1, axis=0), np.maximum(moves, np.roll(moves, -1))
    along = after - outline
    to = outline[:, None] - outline
    share = np.clip((to * along).sum(-1) / (along**2).sum(-1), 0.0, 1.0)
    distance = np.linalg.norm(to - share[..., None] * along, axis=-1)
    vertex, edge = np.indices(distance.shape)
    own = (vertex == edge) | (vertex == (edge + 1) % len(outline))
    return bool(np.all(own | (distance > moves[:, None] + reach)))


def _crossing(outlines: Float[np.ndarray, "polygons vertices 2"]) -> Num[np.ndarray, "polygons 2"]:
    """The first two edges that touch without being neighbours, or fold back on each other; -1 where none do."""
    many, count = outlines.shape[:2]
    found = np.full((many, 2), -1)
    for i, j in itertools.combinations(range(count), 2):
        a, b, c, d = (outlines[:, k % count] for k in (i, i + 1, j, j + 1))
        if j == i + 1:
            bad = _folds(a, b, d)
        elif i == 0 and j == count - 1:
            bad = _folds(c, a, b)
        else:
            bad = _meet(a, b, c, d)
        found[bad & (found[:, 0] < 0)] = i, j
    return found


def _folds(before, shared, after) -> Bool[np.ndarray, "polygons"]:
    """Whether neighbouring edges lie on one line, on the same side of their shared vertex."""
    return (_side(before, shared, after) == 0) & (((before - shared) * (after - shared)).sum(-1) > 0)


def _meet(a, b, c, d) -> Bool[np.ndarray, "polygons"]:
    """Whether the edge from a to b has a point in common with the one from c to d."""
    turns = _side(a, b, c), _side(a, b, d), _side(c, d, a), _side(c, d, b)
    proper = (turns[0] * turns[1] < 0) & (turns[2] * turns[3] < 0)
    ends = (a, b, c), (a, b, d), (c, d, a), (c, d, b)
    on = [(turn == 0) & _within(*three) for turn, three in zip(turns, ends, strict=True)]
    return proper | np.any(on, axis=0)


def _side(a, b, c):
    """1 where c lies to the left of the way from a to b, -1 to the right, 0 on its line."""
    return np.sign(
        (b[..., 0] - a[..., 0]) * (c[..., 1] - a[..., 1]) - (b[..., 1] - a[..., 1]) * (c[..., 0] - a[..., 0])
    )


def _within(a, b, c):
    """Whether c lies in the rectangle about a and b."""
    return ((np.minimum(a, b) <= c) & (c <= np.maximum(a, b))).all(-1)
