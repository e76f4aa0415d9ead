"""Scenes: a polygon, a hand, and a plan of contact formations. Immutable pytrees, SI units, radians.

Frames follow design: `x` right, `y` up, the palm's surface is `y = 0`; finger 1 is the right one, finger 2 the left
one; `theta` is measured anticlockwise from `+x`. The object's frame sits at its centre of mass with the axes of the
given vertices.
"""

import enum
import functools
import re
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from wholearm_jax.core import as_device_array

COORDINATES = ("x", "y", "phi", "theta1", "theta2")
ANGLE_COORDINATES = ("phi", "theta1", "theta2")
LINKS = ("palm", "finger1", "finger2")
FLUSH_TOLERANCE = 1e-6  # [m]
VERTEX, EDGE = 0, 1  # contact types: A, an object vertex on a link; B, a fingertip on an object edge
AWAY = 4  # no contact: a finger that touches nothing and stands still (2 and 3 are corners of links, `kinematics`)
_CONTACT_PATTERN = re.compile(r"(palm|finger1|finger2):([ve])([0-9]+)( rolling)?")
AWAY_NAMES = tuple(f"{finger}:away" for finger in LINKS[1:])


class MassProperties(NamedTuple):
    """Area, centroid and second moment of area about the centroid of a polygon."""

    area: Float[Array, ""]
    centroid: Float[Array, "2"]
    second_moment: Float[Array, ""]


class Polygon(eqx.Module):
    """The object: a rigid polygon with anticlockwise vertices.

    `vertices` is padded to a multiple of eight rows, so that polygons of different size share one compiled program;
    `count` says how many rows are real. `friction` holds one coefficient for each link (palm, finger 1, finger 2).
    `inertia` [kg m^2] and `center_of_mass` [m] are None for a uniform density.
    A vertex that begins within `flush_tolerance` [m] behind a link lies flush on it (None: `FLUSH_TOLERANCE`).
    """

    vertices: Float[Array, "capacity 2"]
    count: Int[Array, ""]
    mass: Float[Array, ""]
    friction: Float[Array, "3"]
    inertia: Float[Array, ""] | None = None
    center_of_mass: Float[Array, "2"] | None = None
    flush_tolerance: Float[Array, ""] | None = None


class Hand(eqx.Module):
    """A palm on `y = 0` and two single-link fingers; row 0 of each array is finger 1, row 1 finger 2.

    A finger is the strip from its contact edge, `offset` from the joint axis toward the object, to its back, `back`
    from the axis on the other side; both are 0 for a segment.
    """

    joint: Float[Array, "2 2"]  # [m]
    length: Float[Array, "2"]  # [m]
    offset: Float[Array, "2"]  # [m]
    back: Float[Array, "2"]  # [m]
    range: Float[Array, "2 2"]  # least and largest joint angle [rad]
    inertia: Float[Array, "2"]  # J of eq. (1) [kg m^2]
    viscous: Float[Array, "2"]  # B [N m s]
    dry: Float[Array, "2"]  # D [N m]
    torque_limit: Float[Array, "2"]  # [N m]
    layered: Bool[Array, ""]  # whether the fingers lie in planes of their own and pass each other
    clearance: Float[Array, ""]  # between fingers in one plane, which meet where they are nearer [m]


class ContactFormation(eqx.Module):
    """A contact formation as data: one row a constraint, with the contact's link (0 palm, 1, 2), type (`VERTEX`,
    `EDGE`) and feature number.

    A sliding contact has one row, its gap. A rolling contact has two, one behind the other: its gap, then its slip,
    marked `tangential`. A finger that is away has one row, behind all others: its joint angle. Four rows make a path:
    `2R + S = 4`.
    """

    link: Int[Array, "rows"]
    kind: Int[Array, "rows"]
    feature: Int[Array, "rows"]
    tangential: Bool[Array, "rows"]
    is_away: Bool[Array, "rows"] | None = None  # whether a row holds a finger that is away; None: no row does

    @property
    def names(self) -> tuple[str, ...]:
        """The contacts as files write them, e.g. `palm:v5` or `palm:v6 rolling`: one a contact, not one a row."""
        link, kind, feature, tangential = (
            np.asarray(a).tolist() for a in (self.link, self.kind, self.feature, self.tangential)
        )
        rolling = [*tangential[1:], False]
        rows = zip(link, kind, feature, rolling, tangential, strict=True)
        return tuple(contact_name(*row[:3], rolling=row[3]) for row in rows if not row[4] and row[1] != AWAY)

    @property
    def away(self) -> tuple[str, ...]:
        """The fingers that are away, as files write them: `finger1:away`."""
        rows = zip(np.asarray(self.link).tolist(), np.asarray(self.kind).tolist(), strict=True)
        return tuple(contact_name(link, kind, 0) for link, kind in rows if kind == AWAY)

    @property
    def normal_rows(self) -> tuple[int, ...]:
        """The row of each contact's gap."""
        return tuple(np.flatnonzero(~np.asarray(self.tangential) & (np.asarray(self.kind) != AWAY)).tolist())

    @property
    def contact_of_row(self) -> tuple[int, ...]:
        """Which of `names` each row belongs to; that of a finger that is away repeats the first contact's force."""
        rows = np.cumsum(~np.asarray(self.tangential)) - 1
        return tuple(np.where(np.asarray(self.kind) == AWAY, 0, rows).tolist())


class PathTarget(eqx.Module):
    """Which way along the path, and where to stop before its end.

    Travel starts with the sign `sign` in coordinate number `path_coordinate` (-1: in the one that changes most); the
    phase
    ends where coordinate number `until_coordinate` reaches `until_value`, or where the formation ends if that is -1.
    """

    coordinate: Int[Array, ""]
    sign: Float[Array, ""]
    until_coordinate: Int[Array, ""]
    until_value: Float[Array, ""]


class Arrival(enum.IntEnum):
    """How a phase must end, in scene files `arrive` and `hold`; the numbers travel through compiled programs."""

    MOVING = 0  # at its path's end; the next phase takes over at speed, by an inelastic impact
    AT_REST = 1  # at its path's end, without speed
    HOLD = 2  # where it begins: the object stays, and the phase's target means nothing
    ANY_SPEED = 3  # at its path's end, and any speed is lost before the next phase


class Phase(eqx.Module):
    """One contact formation, the direction of travel, the time [s] that it may take, and how it must end.

    `regrasp` names the contact that a finger makes which moves alone while the others hold the object (or
    `finger1:away`); None for any other phase.
    """

    name: str = eqx.field(static=True)
    formation: ContactFormation
    target: PathTarget
    duration: Float[Array | np.ndarray, ""]
    arrive: Arrival = eqx.field(static=True, default=Arrival.AT_REST)
    regrasp: str | None = eqx.field(static=True, default=None)

    @property
    def has_free_finger(self) -> bool:
        """Whether a finger moves alone or stands away: only `simulate` judges what such a finger does."""
        return self.regrasp is not None or self.formation.is_away is not None


class Scene(eqx.Module):
    """A hand, an object, a rough start and a plan; every float in it can be differentiated with respect to.

    `gravity` `(2,)` [m/s^2], `start` `(x, y, phi, theta1, theta2)` [m, rad]. Immutable; copies are made with equinox:

    >>> import equinox as eqx
    >>> scene = wa.load("heptagon")
    >>> eqx.tree_at(lambda s: s.object.friction, scene, 1.2 * scene.object.friction).object.friction.tolist()
    [0.12, 0.12, 0.12]
    """

    title: str = eqx.field(static=True)
    gravity: Float[Array | np.ndarray, "2"]
    hand: Hand
    object: Polygon
    start: Float[Array, "5"]
    phases: tuple[Phase, ...]


class RigidBody(eqx.Module):
    """What the dynamics need of a polygon: vertices about the centre of mass, mass, inertia, friction."""

    vertices: Float[Array, "capacity 2"]
    count: Int[Array, ""]
    mass: Float[Array, ""]
    inertia: Float[Array, ""]
    friction: Float[Array, "3"]
    flush_tolerance: Float[Array, ""]


def polygon(vertices, mass, friction, inertia=None, center_of_mass=None, flush_tolerance=None) -> Polygon:
    """Build a `Polygon` from `(n, 2)` vertices; `friction` is a number or one for each link."""
    given = np.asarray(vertices, float)
    padding = np.broadcast_to(given[-1], (-len(given) % 8, 2))
    return Polygon(
        vertices=as_device_array(np.concatenate([given, padding])),
        count=as_device_array(len(given), int),
        mass=as_device_array(mass, float),
        friction=as_device_array(np.broadcast_to(np.asarray(friction, float), (3,))),
        inertia=None if inertia is None else as_device_array(inertia, float),
        center_of_mass=None if center_of_mass is None else as_device_array(center_of_mass, float),
        flush_tolerance=None if flush_tolerance is None else as_device_array(flush_tolerance, float),
    )


def contact_formation(contacts) -> ContactFormation:
    """Build a `ContactFormation` from contact names such as `"palm:v5"`, `"finger2:e3"` or `"palm:v6 rolling"`.

    `"finger1:away"` stands for a finger that touches nothing and stands still.
    """
    rows = []
    for *feature, rolling in sorted(map(parse_contact, contacts), key=lambda row: row[1] == AWAY):
        rows += [(*feature, tangential) for tangential in (False, True)[: 1 + rolling]]
    formation = ContactFormation(*(as_device_array(column) for column in zip(*rows, strict=True)))
    is_away = [row[1] == AWAY for row in rows]
    return eqx.tree_at(_away_rows, formation, as_device_array(is_away), is_leaf=_is_none) if any(is_away) else formation


def alike_formations(formations: Sequence[ContactFormation]) -> tuple[ContactFormation, ...]:
    """Return formations that can be stacked: if a finger is away in one of them, all say of each row whether it is."""
    if all(one.is_away is None for one in formations):
        return tuple(formations)
    return tuple(
        eqx.tree_at(_away_rows, one, one.kind == AWAY, is_leaf=_is_none) if one.is_away is None else one
        for one in formations
    )


def _away_rows(formation: ContactFormation):
    return formation.is_away


def _is_none(leaf) -> bool:
    return leaf is None


def path_target(toward: str | None, until: Mapping[Any, float] | None = None) -> PathTarget:
    """Build a `PathTarget` from a coordinate and a sign (`"x-"`; None: either way) and an optional `{coordinate:
    value}`
    to stop at."""
    coordinate, value = next(iter(until.items())) if until else (None, 0.0)
    return PathTarget(
        coordinate=as_device_array(COORDINATES.index(toward[:-1]) if toward else -1, int),
        sign=as_device_array(-1.0 if toward and toward[-1] == "-" else 1.0, float),
        until_coordinate=as_device_array(-1 if coordinate is None else COORDINATES.index(coordinate), int),
        until_value=as_device_array(value, float),
    )


@functools.lru_cache(maxsize=4096)
def parse_contact(text: str) -> tuple[int, int, int, bool]:
    """`"finger2:e3 rolling"` -> (link, kind, feature, rolling); `"finger1:away"` -> (1, AWAY, 0, False).

    Raises ValueError for anything else.
    """
    if text.strip() in AWAY_NAMES:
        return 1 + AWAY_NAMES.index(text.strip()), AWAY, 0, False
    match = _CONTACT_PATTERN.fullmatch(text.strip())
    if match is None:
        raise ValueError(f"'{text}' is not a contact; write LINK:vN or LINK:eN, e.g. palm:v5 or finger2:e3")
    link, letter, number, rolling = match.groups()
    if letter == "e" and link == "palm":
        raise ValueError(f"'{text}': the palm has no tip; only fingers touch an edge")
    return LINKS.index(link), VERTEX if letter == "v" else EDGE, int(number), rolling is not None


def feature_pair(contact: str) -> str:
    """The two features of a contact, whether it slides or rolls: `palm:v6` of `palm:v6 rolling`."""
    return contact.partition(" ")[0]


def contact_name(link: int, kind: int, feature: int, *, rolling: bool = False) -> str:
    """The inverse of `parse_contact`."""
    if kind == AWAY:
        return AWAY_NAMES[link - 1]
    return f"{LINKS[link]}:{'v' if kind == VERTEX else 'e'}{feature}" + (" rolling" if rolling else "")


def next_vertex(count: Int[Array, ""], capacity: int) -> Int[Array, "capacity"]:
    """The number of the vertex after each one, closing the polygon at `count`."""
    following = jnp.arange(1, capacity + 1)
    return jnp.where(following < count, following, 0)


def mass_properties(vertices: Float[Array, "capacity 2"], count: Int[Array, ""]) -> MassProperties:
    """Area, centroid and polar second moment about the centroid, by Green's theorem over the edges."""
    here, there = vertices, vertices[next_vertex(count, vertices.shape[0])]
    real = jnp.arange(vertices.shape[0]) < count
    origin = jnp.where(real[:, None], vertices, 0.0).sum(0) / count  # sums about a nearby point keep their digits
    here, there = here - origin, there - origin
    cross = jnp.where(real, here[:, 0] * there[:, 1] - here[:, 1] * there[:, 0], 0.0)
    area = cross.sum() / 2
    centroid = (cross[:, None] * (here + there)).sum(0) / (6 * area)
    polar = (cross[:, None] * (here**2 + here * there + there**2)).sum() / 12
    return MassProperties(area, centroid + origin, polar - area * centroid @ centroid)


@jax.jit
def rigid_body(shape: Polygon) -> RigidBody:
    """The polygon about its centre of mass, with the inertia of a uniform density unless the scene gives its own."""
    uniform = mass_properties(shape.vertices, shape.count)
    center = uniform.centroid if shape.center_of_mass is None else shape.center_of_mass
    away = uniform.centroid - center
    own = shape.mass * (uniform.second_moment / uniform.area + away @ away)
    return RigidBody(
        vertices=shape.vertices - center,
        count=shape.count,
        mass=shape.mass,
        inertia=own if shape.inertia is None else shape.inertia,
        friction=shape.friction,
        flush_tolerance=jnp.full_like(shape.mass, FLUSH_TOLERANCE)
        if shape.flush_tolerance is None
        else shape.flush_tolerance,
    )


def object_radius(shape: Polygon) -> float:
    """Return the distance of the farthest vertex from the centre of mass [m]."""
    return float(np.hypot(*np.asarray(rigid_body(shape).vertices).T).max())


def replace_duration(phase: Phase, duration) -> Phase:
    """A phase with another duration."""
    return eqx.tree_at(lambda p: p.duration, phase, as_device_array(duration, float))
