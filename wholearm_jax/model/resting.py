"""The configuration in which an object rests on the palm with one edge down and both fingers are closed on it.

An edge here is one of the convex hull, named after the vertex at which it begins: a part that is not convex may rest on
two vertices, or two feet, with a gap between.
"""

import itertools

import numpy as np
import shapely
from jaxtyping import Float

from wholearm_jax.model.scene import Hand, Polygon, rigid_body


def resting_configuration(shape: Polygon, hand: Hand, edge: int, x: float) -> np.ndarray:
    """Place an object at rest on an edge, and close each finger from outside until it touches.

    Args:
        shape: the object.
        hand: the hand.
        edge: the edge that lies on the palm, from vertex `edge` to the next of the convex hull.
        x: the centre of mass's x [m].

    Returns:
        `z` (5,) in SI units.

    Raises:
        ValueError: if the object has no such edge, cannot lie on it, lies on a finger's joint, or a finger does not
            reach it.
    """
    body = rigid_body(shape)
    count = int(body.count)
    corners = np.asarray(body.vertices)[:count]
    phi = resting_angle(corners, edge)
    turn = np.array([[np.cos(phi), -np.sin(phi)], [np.sin(phi), np.cos(phi)]])
    at = corners @ turn.T
    height = -at[edge, 1]
    if at[:, 1].min() < -height - 1e-9 * np.ptp(corners):
        raise ValueError(f"e{edge}: the object cannot lie on this edge: another vertex is lower")
    at = at + np.array([x, height])
    place, outline = f"e{edge} at x = {x:.4g} m", shapely.Polygon(at)
    for finger, joint in enumerate(np.asarray(hand.joint)):
        if outline.distance(shapely.Point(joint)) <= 1e-9 * np.ptp(corners):
            raise ValueError(f"{place}: the object lies on the joint of finger{finger + 1}")
    angles = [_closing_angle(at, hand, finger) for finger in range(2)]
    for finger, angle in enumerate(angles):
        if angle is None:
            raise ValueError(f"{place}: finger{finger + 1} does not reach the object")
    return np.array([x, height, phi, *angles], float)


def resting_angle(corners: np.ndarray, edge: int) -> float:
    """Return the angle `phi` [rad] at which an edge of a polygon `(count, 2)` lies down on the palm.

    Raises:
        ValueError: if the polygon has no such edge.
    """
    count = len(corners)
    if not 0 <= edge < count:
        raise ValueError(f"e{edge}: the object has edges 0 to {count - 1}")
    return lying_angle(corners, edge, hull_edges(corners).get(edge, (edge + 1) % count))


def lying_angle(corners: Float[np.ndarray, "count 2"], first: int, last: int) -> float:
    """Return the angle `phi` [rad] at which the line from one vertex of a polygon to another lies down on the palm."""
    along = corners[last] - corners[first]
    return -float(np.arctan2(along[1], along[0]))


def hull_edges(corners: Float[np.ndarray, "count 2"]) -> dict[int, int]:
    """Return the edges of a polygon's convex hull: the last vertex of each, by the first."""
    ring = shapely.get_coordinates(shapely.MultiPoint(corners).convex_hull)
    if not shapely.is_ccw(shapely.linearrings(ring)):
        ring = ring[::-1]
    number = {tuple(corner): k for k, corner in enumerate(corners.tolist())}
    return {number[first]: number[last] for first, last in itertools.pairwise(map(tuple, ring.tolist()))}


def edge_on_palm(shape: Polygon, z: np.ndarray) -> int:
    """Return the edge of an object that lies on the palm at a configuration `z` (5,) in SI units.

    Raises:
        ValueError: if none does.
    """
    body = rigid_body(shape)
    corners = np.asarray(body.vertices)[: int(body.count)]
    heights = z[1] + np.sin(z[2]) * corners[:, 0] + np.cos(z[2]) * corners[:, 1]
    on_palm = np.flatnonzero(np.abs(heights) <= 1e-6 * np.ptp(corners))
    if len(on_palm) < 2:
        raise ValueError("start: the object does not lie on an edge")
    across = np.cos(z[2]) * corners[on_palm, 0] - np.sin(z[2]) * corners[on_palm, 1]
    return int(on_palm[np.argmin(across)])


def _closing_angle(corners: np.ndarray, hand: Hand, finger: int) -> float | None:
    """Return the joint angle at which a finger, closing from outside, first touches; None: it never does."""
    joint, length, offset = (np.asarray(a)[finger] for a in (hand.joint, hand.length, hand.offset))
    if finger == 1:  # mirrored, it closes as finger 1 does
        corners, joint = corners[::-1] * [-1, 1], joint * [-1, 1]
    away = corners - joint
    distance = np.hypot(*away.T)
    # A vertex on the contact edge.
    reach = np.sqrt(np.maximum(distance**2 - offset**2, 0.0))
    on_edge = (distance > abs(offset)) & (reach <= length)
    angles = [
        np.arctan2(y, x) - np.arcsin(offset / d) for (x, y), d in zip(away[on_edge], distance[on_edge], strict=True)
    ]
    # The tip on an edge of the object: its circle about the joint meets the edge's line.
    radius, lead = np.hypot(length, offset), np.arctan2(offset, length)
    for begin, end in zip(away, np.roll(away, -1, axis=0), strict=True):
        along = end - begin
        a, b, c = along @ along, 2 * begin @ along, begin @ begin - radius**2
        if b**2 - 4 * a * c > 0:
            for t in (-b + np.array([-1, 1]) * np.sqrt(b**2 - 4 * a * c)) / (2 * a):
                if 0 < t < 1:
                    point = begin + t * along
                    angles.append(np.arctan2(point[1], point[0]) - lead)
    closing = [angle for angle in angles if -np.pi / 2 < angle]
    if not closing:
        return None
    first = float(min(closing))
    return first if finger == 0 else np.pi - first
