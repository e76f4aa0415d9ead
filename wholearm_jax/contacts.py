r"""C-functions: gaps, normals and slip of contacts between a polygon and a hand, all as data.

Configuration `z = (x, y, phi, theta1, theta2)`. Every contact, of type A (object vertex on a link's edge) or B
(fingertip on an object edge), has a normal `n` into the object, a tangent `t` (`n` turned by -90 degrees), a point `P`
and a gap `C`. With the object's origin `q` and the link's joint `j` the rows of the paper's eq. (4) are

    G_n = [ n,  t.(P - q),  -t.(P - j) on the link's own joint ]      dC/dz
    G_t = [ t, -n.(P - q),   n.(P - j) on the link's own joint ]      slip velocity of the object against the link

because `n.S r = t.r` and `t.S r = -n.r` for the quarter turn `S`.

A formation constrains the gap of every contact, and the slip of those that roll. On straight features the latter is
holonomic: the place `along` its feature at which the contact touches stays `held`, and the constraint

    C_t = along - held  (palm, finger 1),  held - along  (finger 2, fingertips),      dC_t/dz = G_t exactly.

Derivation: section 1 of `docs/derivation.md`.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from wholearm_jax.scene import EDGE, VERTEX, Body, Formation, Hand, next_vertex


class Contacts(eqx.Module):
    """Contacts as arrays; the leading axis runs over the constraints of a formation (`Formation`).

    `along` (see `Frame`) must stay within `[lower, upper]`: the link's extent for type A, the edge's for type B.
    `tangential` marks rows that constrain the slip, at the place `held`, and `slides` those of contacts that may slip.
    """

    on_link: Bool[Array, "slots"]
    finger: Float[Array, "slots 2"]
    side: Float[Array, "slots"]
    joint: Float[Array, "slots 2"]
    reach: Float[Array, "slots"]
    offset: Float[Array, "slots"]
    point: Float[Array, "slots 2"]
    edge: Float[Array, "slots 2"]
    lower: Float[Array, "slots"]
    upper: Float[Array, "slots"]
    friction: Float[Array, "slots"]
    tangential: Bool[Array, "slots"]
    slides: Bool[Array, "slots"]
    held: Float[Array, "slots"]


class Frame(eqx.Module):
    """A contact at one configuration: gap `C`, place `along` its feature, normal, point against `q` and against `j`."""

    gap: Float[Array, ""]
    along: Float[Array, ""]
    normal: Float[Array, "2"]
    from_object: Float[Array, "2"]
    from_joint: Float[Array, "2"]


def contacts(body: Body, hand: Hand, formation: Formation) -> Contacts:
    """Gather the geometry of a formation (or of any list of link, kind, feature)."""
    finger = jax.nn.one_hot(formation.link - 1, 2, dtype=body.mass.dtype)
    palm = formation.link == 0
    on_link = formation.kind == VERTEX
    start = body.vertices[formation.feature]
    end = body.vertices[next_vertex(body.count, body.vertices.shape[0])[formation.feature]]
    # A padded edge has no length: give it one before dividing, so that its (unused) derivative stays finite.
    extent = jnp.where(jnp.all(start == end, axis=1)[:, None], jnp.ones_like(start), end - start)
    length = jnp.sqrt((extent**2).sum(1))
    palm_lower, palm_upper = hand.joint[1, 0], hand.joint[0, 0]
    reach = finger @ hand.length
    return Contacts(
        on_link=on_link,
        finger=finger,
        side=jnp.where(formation.link == 2, -1.0, 1.0).astype(body.mass.dtype),
        joint=finger @ hand.joint,
        reach=reach,
        offset=finger @ hand.offset,
        point=start,
        edge=extent / length[:, None],
        lower=jnp.where(on_link & palm, palm_lower, 0.0),
        upper=jnp.where(on_link, jnp.where(palm, palm_upper, reach), length),
        friction=body.friction[formation.link],
        tangential=formation.tangential,
        slides=~formation.tangential & ~jnp.roll(formation.tangential, -1),
        held=jnp.zeros_like(length),
    )


def placed(several: Contacts, z: Float[Array, "5"]) -> Contacts:
    """Contacts that roll stay from now on at the places `along` their features which they have at `z`."""
    return eqx.tree_at(lambda c: c.held, several, frames(several, z).along)


def every_contact(capacity: int) -> Formation:
    """All pairs that may touch: each vertex on each link, each fingertip on each edge (`5 * capacity` rows)."""
    number = jnp.arange(capacity)
    link = jnp.concatenate([jnp.full(capacity, k) for k in (0, 1, 2, 1, 2)])
    kind = jnp.repeat(jnp.asarray([VERTEX, VERTEX, VERTEX, EDGE, EDGE]), capacity)
    return Formation(link, kind, jnp.tile(number, 5), jnp.zeros(5 * capacity, bool))


def frame(contact: Contacts, z: Float[Array, "5"]) -> Frame:
    """One contact (no leading axis) at configuration `z`."""
    q, phi, theta = z[:2], z[2], contact.finger @ z[3:]
    c, s = jnp.cos(phi), jnp.sin(phi)
    rotation = jnp.stack([jnp.stack([c, -s]), jnp.stack([s, c])])
    direction = jnp.stack([jnp.cos(theta), jnp.sin(theta)])
    link_normal = contact.side * jnp.stack([-direction[1], direction[0]])
    feature = q + rotation @ contact.point  # the vertex (A) or the edge's start (B)
    tip = contact.joint + contact.reach * direction + contact.offset * link_normal
    edge = rotation @ contact.edge
    edge_normal = jnp.stack([-edge[1], edge[0]])  # into the object
    from_joint = feature - contact.joint
    to_tip = tip - feature
    where = jnp.where(contact.on_link, feature, tip)
    return Frame(
        gap=jnp.where(contact.on_link, link_normal @ from_joint - contact.offset, -(edge_normal @ to_tip)),
        along=jnp.where(contact.on_link, direction @ from_joint, edge @ to_tip),
        normal=jnp.where(contact.on_link, link_normal, edge_normal),
        from_object=where - q,
        from_joint=where - contact.joint,
    )


def frames(several: Contacts, z: Float[Array, "5"]) -> Frame:
    """`frame` for every contact."""
    return jax.vmap(frame, (0, None))(several, z)


def gaps(several: Contacts, z: Float[Array, "5"]) -> Float[Array, "contacts"]:
    """The C-functions `C_n(z)` [m]: 0 in contact, positive apart."""
    return frames(several, z).gap


def normal_rows(several: Contacts, z: Float[Array, "5"]) -> Float[Array, "contacts 5"]:
    """`G_n = dC_n/dz`, the paper's `[W_n^T, -J_n]`."""
    at = frames(several, z)
    return _velocity_rows(several, at, at.normal)


def slip_rows(several: Contacts, z: Float[Array, "5"]) -> Float[Array, "contacts 5"]:
    """`G_t`, the paper's `[W_t^T, -J_t]`: slip velocity is `G_t z_dot`, the object against the link."""
    at = frames(several, z)
    return _velocity_rows(several, at, _turned(at.normal))


def slips(several: Contacts, z: Float[Array, "5"], x: Float[Array, "5"]) -> Float[Array, "slots"]:
    """`G_t x` of the contacts that may slip; 0 for those that roll."""
    return jnp.where(several.slides, slip_rows(several, z) @ x, 0.0)


def constraints(several: Contacts, z: Float[Array, "5"]) -> Float[Array, "slots"]:
    """What a formation keeps at zero: gaps `C_n(z)`, and `C_t(z)` in the tangential rows of rolling contacts."""
    at = frames(several, z)
    sense = jnp.where(several.on_link, several.side, -1.0)
    return jnp.where(several.tangential, sense * (at.along - several.held), at.gap)


def constraint_rows(several: Contacts, z: Float[Array, "5"]) -> Float[Array, "slots 5"]:
    """The gradient `G` of `constraints`: `G_n`, and `G_t` in the tangential rows."""
    at = frames(several, z)
    return _velocity_rows(several, at, jnp.where(several.tangential[:, None], _turned(at.normal), at.normal))


def constraint_curvature(several: Contacts, z: Float[Array, "5"], x: Float[Array, "5"]) -> Float[Array, "slots"]:
    """`x^T (d2C/dz2) x` for each constraint: what `G x' = -x^T H x` needs."""
    _, rate = jax.jvp(lambda at: constraint_rows(several, at) @ x, (z,), (x,))
    return rate


def _velocity_rows(several: Contacts, at: Frame, direction: Float[Array, "slots 2"]) -> Float[Array, "slots 5"]:
    """Rows whose product with `z_dot` is the velocity along a direction at the contact, the object against the link."""
    across = _turned(direction)
    arm = -(across * at.from_joint).sum(1)
    turn = (across * at.from_object).sum(1)
    return jnp.concatenate([direction, turn[:, None], arm[:, None] * several.finger], axis=1)


def _turned(normal: Float[Array, "contacts 2"]) -> Float[Array, "contacts 2"]:
    return jnp.stack([normal[:, 1], -normal[:, 0]], axis=1)
