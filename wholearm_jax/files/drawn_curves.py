"""Curves of a drawing: chains of points in metres, joined end to end until they close.

A drawing gives an outline as one closed curve or as many pieces. Pieces whose ends meet are one outline; what is drawn
twice counts once; what does not close, branches or crosses is refused with the place at which it does.
"""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
import shapely
from jaxtyping import Float

from wholearm_jax.core import SceneError

MEETING_FRACTION = 1e-3  # ends closer than this fraction of the tolerance are the same point


class DrawnCurves(NamedTuple):
    """What a drawing shows: chains of points [m], and what of it was passed over, in words."""

    chains: list[Float[np.ndarray, "points 2"]]
    skipped: tuple[str, ...] = ()


def close_chains(
    source: str, chains: Iterable[np.ndarray], tolerance: float, unit: float
) -> list[Float[np.ndarray, "points 2"]]:
    """Join chains of points into closed rings, the last point of which is the first.

    Args:
        source: the file, with which messages begin.
        chains: points `(n, 2)` [m].
        tolerance: the largest gap between two ends that are meant to meet [m].
        unit: of the places in messages [m].

    Raises:
        SceneError: where a contour stays open or lines branch.
    """
    chains = [chain for chain in map(_without_repeats, chains) if len(chain) > 1]
    rings, pieces = [], []
    for chain in chains:
        meets = np.hypot(*(chain[0] - chain[-1])) <= MEETING_FRACTION * tolerance
        (rings if meets and len(chain) > 3 else pieces).append(chain)
    pieces = [piece for piece in pieces if _length(piece) > MEETING_FRACTION * tolerance]
    if pieces:
        rings += _join(source, pieces, tolerance, unit)
    return [np.concatenate([ring[:-1], ring[:1]]) for ring in rings]


def name_place(point: Sequence[float] | np.ndarray, unit: float) -> str:
    """Write a point of a drawing in the drawing's own unit."""
    return f"({point[0] / unit:.6g}, {point[1] / unit:.6g})"


def _join(source: str, pieces: list[np.ndarray], tolerance: float, unit: float) -> list[np.ndarray]:
    """Walk from piece to piece, each of whose ends meets one other end."""
    ends = np.array([piece[[0, -1]] for piece in pieces]).reshape(-1, 2)
    node = _clusters(ends, MEETING_FRACTION * tolerance)
    once = _drawn_once(pieces, node.reshape(-1, 2), tolerance)
    pieces, ends = [pieces[k] for k in once], ends.reshape(-1, 2, 2)[once].reshape(-1, 2)
    node = node.reshape(-1, 2)[once].ravel()
    node = _bridge_gaps(source, ends, node, tolerance, unit)
    degree = np.bincount(node)
    branching = np.flatnonzero(degree[node] > 2)
    if len(branching):
        place = name_place(ends[branching[0]], unit)
        raise SceneError(f"{source}: {degree[node[branching[0]]]} lines meet at {place}: an outline does not branch")
    return _walk(pieces, node)


def _walk(pieces: list[np.ndarray], node: np.ndarray) -> list[np.ndarray]:
    """Follow the pieces round: at each node two ends meet."""
    meeting = np.argsort(node, kind="stable").reshape(-1, 2)
    partner = np.empty(len(node), int)
    partner[meeting[:, 0]], partner[meeting[:, 1]] = meeting[:, 1], meeting[:, 0]
    left, rings = set(range(len(pieces))), []
    while left:
        end, ring = 2 * min(left), []
        while end // 2 in left:
            piece = pieces[end // 2]
            left.remove(end // 2)
            ring.append((piece[::-1] if end % 2 else piece)[:-1])
            end = int(partner[end ^ 1])
        ring.append(ring[0][:1])
        rings.append(np.concatenate(ring))
    return rings


def _bridge_gaps(source: str, ends: np.ndarray, node: np.ndarray, tolerance: float, unit: float) -> np.ndarray:
    """Give ends that meet no other, but one another within the tolerance, the same node."""
    from scipy.spatial import KDTree  # a tenth of the time that it takes to import the whole package

    loose = np.flatnonzero(np.bincount(node)[node] == 1)
    if not len(loose):
        return node
    node = node.copy()
    distance, nearest = map(np.asarray, KDTree(ends[loose]).query(ends[loose], k=2))
    # The nearest other end: of two at the same place, either may come first.
    other = np.where(nearest[:, 0] == np.arange(len(loose)), nearest[:, 1], nearest[:, 0])
    for k, end in enumerate(loose):
        gap = distance[k, 1]
        if gap > tolerance or other[other[k]] != k:
            near = f"; the nearest end is {gap / unit:.3g} away" if np.isfinite(gap) else ""
            raise SceneError(f"{source}: open contour: a line ends at {name_place(ends[end], unit)}{near}")
        node[end] = min(node[end], node[loose[other[k]]])
    return np.unique(node, return_inverse=True)[1]


def _clusters(points: np.ndarray, distance: float) -> np.ndarray:
    """Number the groups of points that lie within a distance of one another."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import KDTree

    pairs = KDTree(points).query_pairs(distance, output_type="ndarray")
    graph = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(points),) * 2)
    return connected_components(graph, directed=False)[1]


def _drawn_once(pieces: list[np.ndarray], nodes: np.ndarray, tolerance: float) -> list[int]:
    """Return the numbers of the pieces without those that repeat another one, forward or backward."""
    kept: list[int] = []
    between: dict[tuple[int, int], list[int]] = {}
    for k, (first, last) in enumerate(nodes.tolist()):
        others = between.setdefault((min(first, last), max(first, last)), [])
        line = shapely.LineString(pieces[k])
        if any(shapely.hausdorff_distance(line, shapely.LineString(pieces[o])) <= tolerance for o in others):
            continue
        others.append(k)
        kept.append(k)
    return kept


def _without_repeats(chain: np.ndarray) -> np.ndarray:
    """Drop points that repeat the one before."""
    chain = np.asarray(chain, float).reshape(-1, 2)
    return chain[np.concatenate([[True], np.any(chain[1:] != chain[:-1], axis=1)])] if len(chain) else chain


def _length(chain: np.ndarray) -> float:
    return float(np.hypot(*np.diff(chain, axis=0).T).sum())
