r"""C-functions: gaps, normals and slip of contacts between a polygon and a hand, all as data.

Configuration `z = (x, y, phi, theta1, theta2)`. Every contact, of type A (object vertex on a link's edge) or B
(fingertip on an object edge), has a normal `n` into the object, a tangent `t` (`n` turned by -90 degrees), a point `P`
and a gap `C`. With the object's origin `q` and the link's joint `j` the rows of the paper's eq. (4) are

    G_n = [ n,  t.(P - q),  -t.(P - j) on the link's own joint ]      dC/dz
    G_t = [ t, -n.(P - q),   n.(P - j) on the link's own joint ]      slip velocity of the object against the link

because `n.S r = t.r` and `t.S r = -n.r` for the quarter turn `S`.

A formation constrains the gap of every contact, and the slip of those that roll. On straight features the latter is
holonomic: the place `along` its feature at which the contact touches stays `rolling_anchor`, and the constraint

    C_t = along - held  (palm, finger 1),  held - along  (finger 2, fingertips),      dC_t/dz = G_t exactly.

Derivation: section 1 of `docs/derivation.md`.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from wholearm_jax.model.scene import EDGE, VERTEX, ContactFormation, Hand, RigidBody, next_vertex

FINGER_ROOT, PALM_END = (
    2,
    3,
)  # corners that no formation holds, at an edge of the object: where a finger or the palm begins
CORNER_TOL = (
    1e-6  # length units of an edge beside its ends at which it is a vertex of the object that meets such a corner
)
UNBOUNDED = 1e6  # length units beyond which nothing is: limits of what has none
FEATURE_GROUPS = (
    *((0, VERTEX), (1, VERTEX), (2, VERTEX), (1, EDGE), (2, EDGE)),
    *((1, FINGER_ROOT), (2, FINGER_ROOT), (1, PALM_END), (2, PALM_END)),
)
"""Link (of the palm's ends: the finger beside it) and kind of all that may meet, each with every feature in turn."""
CONTACT_GROUPS = 5  # of these groups are contacts that a formation may hold

Vector = tuple[Float[Array, "*contacts"], Float[Array, "*contacts"]]
"""A vector for each contact, by components: put together they would be taken apart again by what is computed next, in
kernels that do nothing else."""


class Carrier(eqx.Module):
    """What carries the object's part of a contact, row by row: the object, or in its place a finger or the palm."""

    object: Float[Array, "rows"]  # 1: the object
    finger: Vector  # 1: finger 1, 2
    base: Vector  # that finger's joint


class ContactSet(eqx.Module):
    """Contacts as arrays; the leading axis runs over the constraints of a formation (`ContactFormation`).

    `along` (see `ContactKinematics`) must stay within `[lower, upper]`: the link's extent for type A, the edge's for
    type B.
    `tangential` marks rows that constrain the slip, at the place `rolling_anchor`, and `slides` those of contacts that
    may slip.
    """

    on_link: Bool[Array, "rows"]
    finger: Vector
    side: Float[Array, "rows"]
    joint: Vector
    reach: Float[Array, "rows"]
    offset: Float[Array, "rows"]
    point: Vector
    edge: Vector
    lower: Float[Array, "rows"]
    upper: Float[Array, "rows"]
    friction: Float[Array, "rows"]
    tangential: Bool[Array, "rows"]
    slides: Bool[Array, "rows"]
    rolling_anchor: Float[Array, "rows"]
    carrier: Carrier | None = None  # None: the object in every row
    is_away: Bool[Array, "rows"] | None = None  # whether a row holds a finger's angle at its anchor; None: no row does


class ContactKinematics(eqx.Module):
    """A contact at one configuration: gap `C`, place `along` its feature, normal, point against `q` and against `j`."""

    gap: Float[Array, "*contacts"]
    along: Float[Array, "*contacts"]
    normal: Vector
    from_object: Vector
    from_joint: Vector


def contact_set(body: RigidBody, hand: Hand, formation: ContactFormation) -> ContactSet:
    """Gather the geometry of a formation (or of any list of link, kind, feature)."""
    of_finger = jax.nn.one_hot(formation.link - 1, 2, dtype=body.mass.dtype)
    of_palm = (formation.kind == PALM_END)[:, None]
    finger = jnp.where(of_palm, 0.0, of_finger)  # the palm's end turns with no finger
    palm, corner = formation.link == 0, formation.kind >= FINGER_ROOT
    beside = jnp.where(corner, CORNER_TOL, 0.0)
    on_link = formation.kind == VERTEX
    start = body.vertices[formation.feature]
    end = body.vertices[next_vertex(body.count, body.vertices.shape[0])[formation.feature]]
    # A padded edge has no length: give it one before dividing, so that its (unused) derivative stays finite.
    extent = jnp.where(jnp.all(start == end, axis=1)[:, None], jnp.ones_like(start), end - start)
    length = jnp.sqrt((extent**2).sum(1))
    along_palm = np.array([1.0, 0.0])  # which ends beside the fingers' joints, these wherever they are
    palm_lower, palm_upper = hand.joint[1, 0], hand.joint[0, 0]
    reach = finger @ hand.length

    def components(vectors) -> Vector:
        return vectors[:, 0], vectors[:, 1]

    contacts = ContactSet(
        on_link=on_link,
        finger=components(finger),
        side=jnp.where(formation.link == 2, -1.0, 1.0).astype(body.mass.dtype),
        joint=components(of_finger @ hand.joint * jnp.where(of_palm, along_palm, 1.0)),
        reach=jnp.where(corner, 0.0, reach),
        offset=finger @ hand.offset,
        point=components(start),
        edge=components(extent / length[:, None]),
        lower=jnp.where(on_link & palm, palm_lower, beside),
        upper=jnp.where(on_link, jnp.where(palm, palm_upper, reach), length - beside),
        friction=body.friction[jnp.where(formation.kind == PALM_END, 0, formation.link)],
        tangential=formation.tangential,
        slides=~formation.tangential & ~jnp.roll(formation.tangential, -1),
        rolling_anchor=jnp.zeros_like(length),
    )
    return contacts if formation.is_away is None else _with_away_rows(contacts, formation.is_away)


def _with_away_rows(contacts: ContactSet, is_away: Bool[Array, "rows"]) -> ContactSet:
    """Turn rows into those of fingers that are away: no feature to leave, no friction, no slip."""
    return eqx.tree_at(
        lambda c: (c.lower, c.upper, c.friction, c.slides, c.is_away),
        contacts,
        (
            jnp.where(is_away, -UNBOUNDED, contacts.lower),
            jnp.where(is_away, UNBOUNDED, contacts.upper),
            jnp.where(is_away, 0.0, contacts.friction),
            contacts.slides & ~is_away,
            is_away,
        ),
        is_leaf=lambda leaf: leaf is None,
    )


def anchor_rolling(contacts: ContactSet, z: Float[Array, "5"]) -> ContactSet:
    """Contacts that roll stay from now on at the places `along` their features which they have at `z`.

    Fingers that are away stay at their angles.
    """
    anchor = contact_kinematics(contacts, z).along
    if contacts.is_away is not None:
        anchor = jnp.where(contacts.is_away, _link_rate(contacts, z), anchor)
    return eqx.tree_at(lambda c: c.rolling_anchor, contacts, anchor)


def contact_candidates(capacity: int) -> ContactFormation:
    """All pairs that may touch: each vertex on each link, each fingertip on each edge (`5 * capacity` rows)."""
    return _on_features(FEATURE_GROUPS[:CONTACT_GROUPS], capacity)


def obstacle_candidates(capacity: int) -> ContactFormation:
    """The same, then each finger's root and each end of the palm on each edge, which stop the object: all
    `FEATURE_GROUPS`."""
    return _on_features(FEATURE_GROUPS, capacity)


def _on_features(groups, capacity: int) -> ContactFormation:
    link, kind = (jnp.repeat(jnp.asarray(column), capacity) for column in zip(*groups, strict=True))
    rows = len(groups) * capacity
    return ContactFormation(link, kind, jnp.tile(jnp.arange(capacity), len(groups)), jnp.zeros(rows, bool))


@jax.jit
def contact_kinematics(contacts: ContactSet, z: Float[Array, "5"]) -> ContactKinematics:
    """Contacts (or one, without a leading axis) at configuration `z`.

    Written by components: that compiles to a seventh of the kernels that small matrix products take.
    """
    (px, py), (ex, ey), (jx, jy), (first, second) = contacts.point, contacts.edge, contacts.joint, contacts.finger
    cosines, sines = _cosines_and_sines(z[2:])
    bx, by, c, s = _carrier_frame(contacts.carrier, z, cosines, sines)
    dx = (1 - first - second) + first * cosines[1] + second * cosines[2]  # along the link
    dy = first * sines[1] + second * sines[2]
    lx, ly = -contacts.side * dy, contacts.side * dx  # the link's normal
    fx, fy = bx + c * px - s * py, by + s * px + c * py  # the vertex (A) or the edge's start (B)
    rx, ry = fx - jx, fy - jy
    tx = contacts.reach * dx + contacts.offset * lx - rx  # from there to the tip
    ty = contacts.reach * dy + contacts.offset * ly - ry
    ex, ey = c * ex - s * ey, s * ex + c * ey
    nx, ny = -ey, ex  # the edge's normal, into the object
    on = contacts.on_link
    wx, wy = fx + jnp.where(on, 0.0, tx), fy + jnp.where(on, 0.0, ty)
    return ContactKinematics(
        gap=jnp.where(on, lx * rx + ly * ry - contacts.offset, -(nx * tx + ny * ty)),
        along=jnp.where(on, dx * rx + dy * ry, ex * tx + ey * ty),
        normal=(jnp.where(on, lx, nx), jnp.where(on, ly, ny)),
        from_object=(wx - bx, wy - by),
        from_joint=(wx - jx, wy - jy),
    )


def _carrier_frame(carrier: Carrier | None, z, cosines, sines):
    """Origin, cosine and sine of the frame of each row's object, or of what stands in its place."""
    if carrier is None:
        return z[0], z[1], cosines[0], sines[0]
    body, (first, second), (jx, jy) = carrier.object, carrier.finger, carrier.base
    c = (1 - body - first - second) + body * cosines[0] + first * cosines[1] + second * cosines[2]
    s = body * sines[0] + first * sines[1] + second * sines[2]
    return body * z[0] + jx, body * z[1] + jy, c, s


@jax.custom_jvp
def _cosines_and_sines(angles):
    """Both by the tangent of the half angle, which XLA computes once: on a CPU it computes cosines and sines again in
    each element of all that they are part of, which takes five times as long as everything else about a contact."""
    half = jnp.tan(angles / 2)
    square = half * half
    return (1 - square) / (1 + square), 2 * half / (1 + square)


@_cosines_and_sines.defjvp
def _(primals, tangents):
    cosines, sines = _cosines_and_sines(*primals)
    return (cosines, sines), (-sines * tangents[0], cosines * tangents[0])


def gaps(contacts: ContactSet, z: Float[Array, "5"]) -> Float[Array, "contacts"]:
    """The C-functions `C_n(z)` [m]: 0 in contact, positive apart."""
    return contact_kinematics(contacts, z).gap


def normal_jacobian(contacts: ContactSet, z: Float[Array, "5"]) -> Float[Array, "contacts 5"]:
    """`G_n = dC_n/dz`, the paper's `[W_n^T, -J_n]`."""
    at = contact_kinematics(contacts, z)
    return _jacobian_along(contacts, at, at.normal)


def tangential_jacobian(contacts: ContactSet, z: Float[Array | np.ndarray, "5"]) -> Float[Array, "contacts 5"]:
    """`G_t`, the paper's `[W_t^T, -J_t]`: slip velocity is `G_t z_dot`, the object against the link."""
    at = contact_kinematics(contacts, z)
    return _jacobian_along(contacts, at, _rotate_minus_90(at.normal))


def contact_velocity(
    contacts: ContactSet,
    at: ContactKinematics,
    x: Float[Array, "5"],
    gap: float | Float[Array, "contacts"],
    along: float | Float[Array, "contacts"],
) -> Float[Array, "contacts"]:
    """How fast `gap C_n + along a` changes where `z` moves at the rate `x`, `a` being places along features.

    Both are velocities in a direction, so that a weighted sum of the directions, (`gap`, `along`), gives the sum. `at`
    are the contacts at `z`.
    """
    (nx, ny), (tx, ty) = at.normal, _rotate_minus_90(at.normal)
    along = along * _feature_sign(contacts)
    return _velocity_along(contacts, at, (gap * nx + along * tx, gap * ny + along * ty), x)


@jax.jit
def slip_velocity(contacts: ContactSet, z: Float[Array, "5"], x: Float[Array, "5"]) -> Float[Array, "rows"]:
    """`G_t x` of the contacts that may slip; 0 for those that roll."""
    return slip_velocity_at(contacts, contact_kinematics(contacts, z), x)


def slip_velocity_at(contacts: ContactSet, at: ContactKinematics, x: Float[Array, "5"]) -> Float[Array, "rows"]:
    """The same, where the contacts are known already."""
    return jnp.where(contacts.slides, _velocity_along(contacts, at, _rotate_minus_90(at.normal), x), 0.0)


@jax.jit
def constraints(contacts: ContactSet, z: Float[Array, "5"]) -> Float[Array, "rows"]:
    """What a formation keeps at zero: gaps `C_n(z)`, and `C_t(z)` in the tangential rows of rolling contacts."""
    at = contact_kinematics(contacts, z)
    values = jnp.where(contacts.tangential, _feature_sign(contacts) * (at.along - contacts.rolling_anchor), at.gap)
    if contacts.is_away is None:
        return values
    return jnp.where(contacts.is_away, _link_rate(contacts, z) - contacts.rolling_anchor, values)


@jax.jit
def constraint_jacobian(contacts: ContactSet, z: Float[Array, "5"]) -> Float[Array, "rows 5"]:
    """The gradient `G` of `constraints`: `G_n`, and `G_t` in the tangential rows."""
    at = contact_kinematics(contacts, z)
    rows = _jacobian_along(contacts, at, _constraint_direction(contacts, at))
    if contacts.is_away is None:
        return rows
    none, (first, second) = jnp.zeros_like(contacts.lower), contacts.finger
    return jnp.where(contacts.is_away[:, None], jnp.stack([none, none, none, first, second], axis=1), rows)


def constraint_velocity(contacts: ContactSet, z: Float[Array, "5"], x: Float[Array, "5"]) -> Float[Array, "rows"]:
    """`G x`, without the rows: a few sums a contact, where only they are wanted."""
    at = contact_kinematics(contacts, z)
    rates = _velocity_along(contacts, at, _constraint_direction(contacts, at), x)
    return rates if contacts.is_away is None else jnp.where(contacts.is_away, _link_rate(contacts, x), rates)


def constraint_second_derivative(
    contacts: ContactSet, z: Float[Array, "5"], x: Float[Array, "5"]
) -> Float[Array, "rows"]:
    """`x^T (d2C/dz2) x` for each constraint: what `G x' = -x^T H x` needs.

    A constraint is `u . r`: a direction `u` on the link (type A) or the object (B), turning at the rate `w`, and the
    way `r` from a point of the same body to one of the other. Along `z + x t` its second derivative is
    `-w^2 u.r + 2 w S u.r' + u.r''`, and `r''` points back to the centres that both points turn about.
    """
    at, on, (dx, dy), turn = contact_kinematics(contacts, z), contacts.on_link, (x[0], x[1]), x[2]
    swing = _link_rate(contacts, x)
    (nx, ny), (ox, oy), (jx, jy) = at.normal, at.from_object, at.from_joint
    rx, ry = ny * at.along - nx * at.gap, -nx * at.along - ny * at.gap  # B: from the edge's start to the tip
    rx, ry = jnp.where(on, jx, rx), jnp.where(on, jy, ry)
    bx, by = jnp.where(on, ox, ox - rx), jnp.where(on, oy, oy - ry)  # the object's point, from its origin
    sign = jnp.where(on, 1.0, -1.0)  # whose point is the far one: the object's, or the link's
    swept = jnp.where(on, 0.0, swing)
    vx = sign * (dx - turn * by) - swept * jy
    vy = sign * (dy + turn * bx) + swept * jx
    ax = -sign * turn**2 * bx - swept**2 * jx
    ay = -sign * turn**2 * by - swept**2 * jy
    w = jnp.where(on, swing, turn)
    ux, uy = jnp.where(contacts.tangential, ny, nx), jnp.where(contacts.tangential, -nx, ny)
    bend = sign * (ux * ax + uy * ay - w**2 * (ux * rx + uy * ry) + 2 * w * (ux * vy - uy * vx))
    return bend if contacts.is_away is None else jnp.where(contacts.is_away, 0.0, bend)


def _feature_sign(contacts: ContactSet) -> Float[Array, "rows"]:
    """The sign by which slip, that of the object against the link, moves a contact `along` its feature."""
    return jnp.where(contacts.on_link, contacts.side, -1.0)


def _constraint_direction(contacts: ContactSet, at: ContactKinematics) -> Vector:
    """The direction in which each constraint keeps the object from moving: the normal, or the tangent."""
    (nx, ny), (tx, ty) = at.normal, _rotate_minus_90(at.normal)
    return jnp.where(contacts.tangential, tx, nx), jnp.where(contacts.tangential, ty, ny)


def _jacobian_along(contacts: ContactSet, at: ContactKinematics, direction: Vector) -> Float[Array, "rows 5"]:
    """Rows whose product with `z_dot` is the velocity along a direction at the contact, the object against the link."""
    ux, uy, turn, arm = _moment_arms(at, direction)
    first, second = contacts.finger
    return jnp.stack([ux, uy, turn, arm * first, arm * second], axis=1)


def _velocity_along(contacts: ContactSet, at: ContactKinematics, direction: Vector, x) -> Float[Array, "rows"]:
    """Those rows times `x`."""
    ux, uy, turn, arm = _moment_arms(at, direction)
    if contacts.carrier is None:
        return ux * x[0] + uy * x[1] + turn * x[2] + arm * _link_rate(contacts, x)
    body, (first, second) = contacts.carrier.object, contacts.carrier.finger
    rate = body * x[2] + first * x[3] + second * x[4]
    return body * (ux * x[0] + uy * x[1]) + turn * rate + arm * _link_rate(contacts, x)


def _link_rate(contacts: ContactSet, x: Float[Array, "5"]) -> Float[Array, "rows"]:
    """How fast each contact's own link turns; the palm does not. Of a configuration: the link's angle."""
    first, second = contacts.finger
    return first * x[3] + second * x[4]


def _moment_arms(at: ContactKinematics, direction: Vector):
    """A direction's components, and its moments about the object's origin and, the other way, the link's joint."""
    (ux, uy), (ox, oy), (jx, jy) = direction, at.from_object, at.from_joint
    return ux, uy, uy * ox - ux * oy, ux * jy - uy * jx


def _rotate_minus_90(normal: Vector) -> Vector:
    x, y = normal
    return y, -x
