"""Obstacles in words: which links meet where a path ends, and what lies in what where a path cannot begin."""

import jax
import numpy as np
from jaxtyping import Array, Float

from wholearm_jax.model import (
    CORNER_TOL,
    FEATURE_GROUPS,
    LINK_OBSTACLES,
    LINKS,
    VERTEX,
    ContactFormation,
    LinkMeeting,
    Phase,
    Scene,
    contact_candidates,
    contact_kinematics,
    contact_name,
    contact_set,
    link_obstacles,
    link_overlaps,
    object_radius,
    rigid_body,
    scaled_mechanics,
)
from wholearm_jax.tracing import feature_clearance, hold_same_tip, lie_before_link, pivot_clearance, run_into_object

STRETCH_PLACES = 17  # of a link's stretch in the object, at which its depth is looked at
LEVEL_ANGLE = 1e-9  # [rad], within which a finger is level with the palm


def describe_obstacle(scene: Scene, z: Float[Array, "5"], row: int) -> str:
    """Say which links meet at `z` (SI), or whose range ends there; `row` is one of `LINK_OBSTACLES`."""
    obstacle = LINK_OBSTACLES[row]
    finger = LINKS[obstacle.link]
    if obstacle.meeting in (LinkMeeting.LEAST_ANGLE, LinkMeeting.LARGEST_ANGLE):
        angle = float(z[2 + obstacle.link])
        level = abs(np.sin(angle)) < LEVEL_ANGLE and float(scene.hand.joint[obstacle.link - 1, 1]) == 0
        return f"{finger} reaches its range at {np.degrees(angle):.4g} deg" + (", level with the palm" if level else "")
    if obstacle.meeting == LinkMeeting.TIP_ON_PALM:
        return f"{finger} meets the palm at x = {float(_place(scene, z, row)):.4g} m"
    if obstacle.meeting == LinkMeeting.PALM_END_ON_FINGER:
        return f"{finger} meets the palm's end at finger{obstacle.palm_end}"
    other, clearance = LINKS[3 - obstacle.link], float(scene.hand.clearance)
    apart = f" (within their clearance of {1e3 * clearance:.3g} mm)" if clearance else ""
    if obstacle.on_tip_face:
        return f"{finger} meets {other} at its tip{apart}"
    part = "" if obstacle.corner[0] else "'s joint"
    return f"{finger}{part} meets {other} {float(_place(scene, z, row)):.3g} m from its joint{apart}"


def _place(scene: Scene, z, row: int) -> float:
    """Where on its line a row's corner is [m]."""
    return float(jax.device_get(_places(scene.hand, z))[row])


@jax.jit
def _places(hand, z):
    return contact_kinematics(link_obstacles(hand).contacts, z).along


def describe_overlaps(scene: Scene, z: Float[Array | np.ndarray, "5"], tolerance: float = 1e-9) -> tuple[str, ...]:
    """Say which links lie in one another or in the object at `z` (SI), at which feature and how deep.

    Args:
        scene: the hand and the object.
        z: a configuration (5,).
        tolerance: a smaller depth is none, in the object's radius or radians; in the object, also one that is flush.

    Returns:
        A line for each pair, the links among themselves first; empty where nothing overlaps.
    """
    radius = object_radius(scene.object)
    between, palm1, palm2, beyond1, beyond2 = (float(v) for v in link_overlaps(scene.hand, z[3:]))
    lines = []
    clearance = float(scene.hand.clearance)
    if between - clearance > tolerance * radius:
        lines.append(f"finger1 and finger2 cross, {1e3 * (between - clearance):.3g} mm deep")
    elif between > tolerance * radius:
        apart = max(clearance - between, 0.0)
        lines.append(f"finger1 and finger2 are {1e3 * apart:.3g} mm apart, of a clearance of {1e3 * clearance:.3g} mm")
    for k, depth in enumerate((palm1, palm2)):
        if depth > tolerance * radius:
            lines.append(f"finger{k + 1} lies {1e3 * depth:.3g} mm below the palm's surface")
    for k, angle in enumerate((beyond1, beyond2)):
        if angle > tolerance:
            lines.append(f"finger{k + 1} is {np.degrees(angle):.3g} deg beyond its range")
    flush_tolerance = float(rigid_body(scene.object).flush_tolerance)
    return (*lines, *_object_overlaps(scene, z, max(tolerance * radius, flush_tolerance)))


def describe_refused_start(scene: Scene, phase: Phase, z: Float[Array, "5"]) -> str | None:
    """Say why no path of a phase can begin at `z` (SI); None where nothing overlaps and contacts are on their features.

    A fingertip at a vertex is named where two contacts hold it, where the finger would cut the vertex off, and where a
    contact rolls there; a vertex where the object lies behind the link that it touches.
    """
    inside, pivots, twice, inward = (np.asarray(a) for a in _formation_places(scene, phase.formation, z))
    names = [phase.formation.names[k] for k in phase.formation.contact_of_row]
    misplaced = dict.fromkeys(
        f"{names[k]} lies {-1e3 * inside[k]:.3g} mm beyond its feature" for k in np.flatnonzero(inside < -1e-9)
    )
    corners = [
        f"{names[i]} and {names[j]} hold a tip at a vertex, where it slips off along either side: keep one of the two"
        for i, j in np.argwhere(np.triu(twice))
    ]
    corners += [f"{names[k]}: the finger comes from the object's side of that edge" for k in np.flatnonzero(inward)]
    corners += [
        f"{names[k]} at the end of its feature, where it slips off: let the phase before it end sooner"
        for k in np.flatnonzero(np.abs(pivots) < CORNER_TOL * object_radius(scene.object))
    ]
    corners += _touched_from_behind(scene, phase.formation, z)
    return "; ".join((*describe_overlaps(scene, z), *misplaced, *corners)) or None


def _touched_from_behind(scene: Scene, formation: ContactFormation, z: Float[Array, "5"]) -> list[str]:
    """Say which vertices touch links behind which the object lies, with both its sides there."""
    in_front = np.asarray(_vertices_in_front(scene, formation, z)).reshape(len(FEATURE_GROUPS), -1)
    rows = zip(*(np.asarray(a).tolist() for a in (formation.link, formation.kind, formation.feature)), strict=True)
    found = {
        f"{contact_name(link, kind, k)}: the object lies behind {LINKS[link]}": None
        for link, kind, k in rows
        if kind == VERTEX and not in_front[FEATURE_GROUPS.index((link, kind)), k]
    }
    return [*found]


@jax.jit
def _vertices_in_front(scene: Scene, formation: ContactFormation, z):
    mechanics = scaled_mechanics(rigid_body(scene.object), scene.hand, scene.gravity, formation)
    gap = contact_kinematics(mechanics.candidates, z / mechanics.configuration_unit).gap
    return lie_before_link(mechanics, gap, mechanics.flush_tolerance)


@jax.jit
def _formation_places(scene: Scene, formation: ContactFormation, z):
    body = rigid_body(scene.object)
    contacts = contact_set(body, scene.hand, formation)
    at = contact_kinematics(contacts, z)
    twice = hold_same_tip(contacts, at, contacts, at)
    inward = run_into_object(contacts, at, z, body.flush_tolerance)
    return feature_clearance(contacts, at), pivot_clearance(contacts, at), twice, inward


def _object_overlaps(scene: Scene, z, tolerance: float) -> list[str]:
    """Say which links lie in the object: behind which of its vertices the link runs, or how deep its tip is."""
    capacity, count = scene.object.vertices.shape[0], int(scene.object.count)
    at, lower, upper = jax.device_get(_object_pairs(scene, z))
    gap, along = (a.reshape(5, capacity)[:, :count] for a in (at.gap, at.along))
    lower, upper = (a.reshape(5, capacity)[:, :count] for a in (lower, upper))
    lines = []
    for link in range(3):  # the first three groups are vertices on the palm and on the fingers
        line = _link_in_object(link, gap[link], along[link], lower[link, 0], upper[link, 0], tolerance)
        if line is not None and line[0] > tolerance:
            depth, feature = line
            size = f"{1e3 * depth:.3g} mm"
            where = (
                f"the object lies {size} below the palm"
                if link == 0
                else f"{LINKS[link]} lies {size} inside the object"
            )
            lines.append(f"{where} at {feature}")
    return lines


@jax.jit
def _object_pairs(scene: Scene, z):
    pairs: ContactFormation = contact_candidates(scene.object.vertices.shape[0])
    contacts = contact_set(rigid_body(scene.object), scene.hand, pairs)
    return contact_kinematics(contacts, z), contacts.lower, contacts.upper


def _link_in_object(link: int, gap, along, lower: float, upper: float, tolerance: float) -> tuple[float, str] | None:
    """Return how deep a link lies in a polygon given by its vertices' places in the link's frame, and where.

    A link that is nowhere farther inside than the tolerance is flush with a side; where its line crosses the polygon,
    and with which vertices beside it, is then decided by rounding.
    """
    following = np.roll(np.arange(len(gap)), -1)
    inside = []  # stretches of the link's line within the polygon
    crossing = np.flatnonzero((gap > 0) != (gap[following] > 0))
    other = following[crossing]
    places = np.sort(along[crossing] + (along[other] - along[crossing]) * gap[crossing] / (gap[crossing] - gap[other]))
    for begin, end in places.reshape(-1, 2):
        begin, end = max(begin, lower), min(end, upper)
        if end > begin:
            inside.append((begin, end))
    if not inside or _depth_inside(inside, np.stack([along, gap], axis=1)) <= tolerance:
        return None
    within = (along >= min(inside)[0] - 1e-12) & (along <= max(end for _, end in inside) + 1e-12)
    longest = max(end - begin for begin, end in inside)
    depths = [(longest, "its tip")] if link > 0 and max(end for _, end in inside) == upper else []
    for side in (-1.0, 1.0) if link > 0 else (-1.0,):  # vertices behind the link, and before it
        depth = np.where(within, side * gap, -np.inf)
        deepest = int(np.argmax(depth))
        depths += [(float(depth[deepest]), f"vertex {deepest}")] if depth[deepest] > 0 else []
    return min(depths, default=None)


def _depth_inside(stretches: list[tuple[float, float]], corners: Float[np.ndarray, "corners 2"]) -> float:
    """Return the largest distance of places along stretches of the x-axis from a polygon's boundary."""
    places = np.concatenate([np.linspace(begin, end, STRETCH_PLACES) for begin, end in stretches])
    points, edges = np.stack([places, np.zeros_like(places)], axis=1)[:, None], np.roll(corners, -1, 0) - corners
    share = ((points - corners) * edges).sum(2) / (edges**2).sum(1)
    nearest = corners + np.clip(share, 0.0, 1.0)[..., None] * edges
    return float(np.linalg.norm(points - nearest, axis=2).min(1).max())
