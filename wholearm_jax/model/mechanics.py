"""One formation's mechanics in the object's own units, so that no result depends on the choice of metre or kilogram.

Length unit: the largest distance of a vertex from the centre of mass. Mass unit: the object's mass. Time stays in
seconds. Angles and `z = (x, y, phi, theta1, theta2)` are then all of order one.

Derivation: section 2 of `docs/derivation.md`.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from wholearm_jax.model.hand_collisions import LinkObstacles, link_obstacles
from wholearm_jax.model.kinematics import ContactSet, contact_set, obstacle_candidates
from wholearm_jax.model.scene import EDGE, VERTEX, ContactFormation, Hand, RigidBody, next_vertex


class ScaledMechanics(eqx.Module):
    """A formation on a hand, dimensionless but for time.

    `inertia` is the diagonal of `M = diag(m, m, I, J1, J2)`; `viscous` and `dry` are B and D; `gravity` is an
    acceleration. `candidates` are all pairs that may touch, `exists` those of features that the object has;
    `may_terminate`
    marks those that could end the formation, `may_be_behind` vertices that may lie behind a link, whose back stops
    them. `links` are the gaps among the links of `hand`. Vertices that begin less than `flush_tolerance` behind a link
    lie flush on it.
    `length` [m] and `mass` [kg] are the units; `torque_limit` stays in N m.
    """

    contacts: ContactSet
    candidates: ContactSet
    exists: Bool[Array, "candidates"]
    may_terminate: Bool[Array, "candidates"]
    may_be_behind: Bool[Array, "candidates"]
    links: LinkObstacles
    hand: Hand
    flush_tolerance: Float[Array, ""]
    inertia: Float[Array, "5"]
    viscous: Float[Array, "2"]
    dry: Float[Array, "2"]
    gravity: Float[Array, "2"]
    length: Float[Array, ""]
    mass: Float[Array, ""]
    torque_limit: Float[Array, "2"]

    @property
    def configuration_unit(self) -> Float[Array, "5"]:
        """What one unit of each coordinate of `z` is in metres or radians."""
        return configuration_unit(self.length)

    @property
    def torque_unit(self) -> Float[Array, ""]:
        """What one unit of torque is in N m, for times in seconds."""
        return self.mass * self.length**2

    @property
    def force_unit(self) -> Float[Array | np.number, ""]:
        """What one unit of force is in N, for times in seconds."""
        return self.mass * self.length


def configuration_unit(length: Float[Array, ""]) -> Float[Array, "5"]:
    """`z` in SI units is `z` in object units times this."""
    one = jnp.ones_like(length)
    return jnp.stack([length, length, one, one, one])


def scaled_mechanics(
    body: RigidBody, hand: Hand, gravity: Float[Array | np.ndarray, "2"], formation: ContactFormation
) -> ScaledMechanics:
    """Scale a formation by the object's size and mass."""
    real = jnp.arange(body.vertices.shape[0]) < body.count
    length, mass = jnp.sqrt(jnp.where(real, (body.vertices**2).sum(1), 0.0).max()), body.mass
    rotary = mass * length**2
    small_body = RigidBody(
        vertices=body.vertices / length,
        count=body.count,
        mass=body.mass / mass,
        inertia=body.inertia / rotary,
        friction=body.friction,
        flush_tolerance=body.flush_tolerance / length,
    )
    small_hand = Hand(
        joint=hand.joint / length,
        length=hand.length / length,
        offset=hand.offset / length,
        back=hand.back / length,
        range=hand.range,
        inertia=hand.inertia / rotary,
        viscous=hand.viscous / rotary,
        dry=hand.dry / rotary,
        torque_limit=hand.torque_limit,
        layered=hand.layered,
        clearance=hand.clearance / length,
    )
    pairs = obstacle_candidates(body.vertices.shape[0])
    touchable = pairs.feature < body.count
    heavy = jnp.stack([small_body.mass, small_body.mass, small_body.inertia])
    return ScaledMechanics(
        contacts=contact_set(small_body, small_hand, formation),
        candidates=contact_set(small_body, small_hand, pairs),
        exists=touchable,
        may_terminate=touchable
        & ~_coincides_with_contact(pairs, formation, body.count)
        & ~_lies_flush(pairs, formation, small_body),
        may_be_behind=_may_be_behind(pairs, formation, _is_convex(body)),
        links=link_obstacles(small_hand),
        hand=small_hand,
        flush_tolerance=small_body.flush_tolerance,
        inertia=jnp.concatenate([heavy, small_hand.inertia]),
        viscous=small_hand.viscous,
        dry=small_hand.dry,
        gravity=jnp.asarray(gravity) / length,
        length=length,
        mass=mass,
        torque_limit=hand.torque_limit,
    )


def _is_convex(body: RigidBody) -> Bool[Array, ""]:
    """Whether no corner of the object turns clockwise."""
    following = next_vertex(body.count, body.vertices.shape[0])
    edge = body.vertices[following] - body.vertices
    turn = edge[:, 0] * edge[following, 1] - edge[:, 1] * edge[following, 0]
    return jnp.all((turn >= 0) | (jnp.arange(turn.shape[0]) >= body.count))


def _may_be_behind(pairs: ContactFormation, formation: ContactFormation, convex) -> Bool[Array, "candidates"]:
    """Vertices against links that they may lie behind: any finger but one that vertices of a convex object slide on."""

    def holds(link):
        return jnp.any((formation.link == link) & (formation.kind == VERTEX))

    return (pairs.kind == VERTEX) & (pairs.link > 0) & ~(convex & jax.vmap(holds)(pairs.link))


def _coincides_with_contact(pairs: ContactFormation, formation: ContactFormation, count) -> Bool[Array, "candidates"]:
    """Pairs that are in the formation or coincide with one of its contacts."""

    def same(link, kind, feature):
        return (formation.link == link) & (formation.kind == kind) & (formation.feature == feature)

    member = jax.vmap(same)(pairs.link, pairs.kind, pairs.feature).any(1)
    # A tip on an edge whose two ends both lie on that finger has no gap of its own: the edge is flush with the link.
    after = jnp.where(pairs.feature + 1 < count, pairs.feature + 1, 0)
    here = jax.vmap(same)(pairs.link, jnp.zeros_like(pairs.kind), pairs.feature).any(1)
    there = jax.vmap(same)(pairs.link, jnp.zeros_like(pairs.kind), after).any(1)
    flush = (pairs.kind == EDGE) & here & there
    return member | flush


def _lies_flush(pairs: ContactFormation, formation: ContactFormation, body: RigidBody) -> Bool[Array, "candidates"]:
    """Vertices on the line through two that a link holds, to within the tolerance: their gap never changes."""

    def on_link(link):
        held = (formation.link == link) & (formation.kind == VERTEX) & ~formation.tangential
        rows = held.shape[0]
        one, other = formation.feature[jnp.argmax(held)], formation.feature[rows - 1 - jnp.argmax(held[::-1])]
        begin, along = body.vertices[one], body.vertices[other] - body.vertices[one]
        away = body.vertices - begin
        across = jnp.abs(along[0] * away[:, 1] - along[1] * away[:, 0])
        return jnp.any(held) & (one != other) & (across <= body.flush_tolerance * jnp.sqrt((along**2).sum()))

    flush = jax.vmap(on_link)(jnp.arange(3))
    return (pairs.kind == VERTEX) & flush[pairs.link, pairs.feature]
