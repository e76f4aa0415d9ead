r"""Terminal events of a path, as rows of one table, and which of them a continuation step crosses.

A path ends where a contact is made, where a contact leaves its feature, where links meet or a joint's range ends, or
where a coordinate reaches the target's value: where a row's value turns negative, or dips below zero and returns within
a step; a vertex behind a finger, and a finger on either side of another, also from below. All rows are the same
function of a contact, with weights of their own,

    value = a gap + b along + c z_k + d1 theta1 + d2 theta2 + shift,

so that a step evaluates them side by side.

Derivation: section 3 of `docs/derivation.md`.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from wholearm_jax.core import eps_power
from wholearm_jax.model import (
    CORNER_TOL,
    Carrier,
    ContactSet,
    PathTarget,
    ScaledMechanics,
    contact_kinematics,
    contact_velocity,
)
from wholearm_jax.tracing.corners import hold_same_tip
from wholearm_jax.tracing.start_checks import lie_before_link

COINCIDENT_FRACTION = 1e-7  # of a step, within which events count as met at the same place


class EventValues(NamedTuple):
    """Values that stay positive on a path, their rates `d/ds`, and places along features."""

    values: Float[Array, "rows"]
    rates: Float[Array, "rows"]
    along: Float[Array, "rows"]


class EventFunctions(NamedTuple):
    """Weights of the terminal events' values.

    Rows: all pairs that may touch (`ScaledMechanics.candidates`), the distances of the formation's contacts to the
    begin and the end of their features, the target's coordinate, and the links among themselves (`LinkObstacles`).
    """

    contacts: ContactSet
    # weights
    gap: Float[Array, "rows"]
    along: Float[Array, "rows"]
    coordinate_weight: Float[Array, "rows"]
    joint_angle: tuple[Float[Array, "rows"], Float[Array, "rows"]]
    shift: Float[Array, "rows"]
    coordinate: Int[Array, ""]  # of the target
    # which crossings end the path
    lower: Float[Array, "rows"]  # within `[lower, upper]` of the feature
    upper: Float[Array, "rows"]
    half_width: Float[Array, "rows"]  # size of the value at which a two-sided row is met
    is_terminal: Bool[Array, "rows"]
    two_sided: Bool[Array, "rows"]  # the value may start negative: then it is met from below
    may_part: Bool[Array, "rows"]  # 0 at the start with a tip at a vertex that another contact holds: may turn negative

    def at(self, z: Float[Array, "5"], slope: Float[Array, "5"]) -> EventValues:
        """Evaluate the events at a place of the path, where `z` changes by `slope` a unit of `s`."""
        here, (first, second) = contact_kinematics(self.contacts, z), self.joint_angle
        return EventValues(
            values=self._values(here, z),
            rates=contact_velocity(self.contacts, here, slope, self.gap, self.along)
            + self.coordinate_weight * slope[self.coordinate]
            + first * slope[3]
            + second * slope[4],
            along=here.along,
        )

    def residual(self, z: Float[Array, "5"], side: float | Float[Array, "*rows"]) -> Float[Array, "*rows"]:
        """Evaluate what vanishes where an event is met on a `side` (1 or -1)."""
        return self._values(contact_kinematics(self.contacts, z), z) - side * self.half_width

    def _values(self, here, z):
        first, second = self.joint_angle
        return (
            self.gap * here.gap
            + self.along * here.along
            + self.coordinate_weight * z[self.coordinate]
            + first * z[3]
            + second * z[4]
            + self.shift
        )


def event_functions(mechanics: ScaledMechanics, target: PathTarget, z: Float[Array, "5"]) -> EventFunctions:
    """Gather the terminal events of a formation's path from `z` on."""
    pairs, held, links = mechanics.candidates, mechanics.contacts, mechanics.links
    until = target.until_coordinate >= 0
    # What begins flush on a link, a little behind it, may stay as deep as it is.
    at, at_held = contact_kinematics(pairs, z), contact_kinematics(held, z)
    depth = -at.gap
    is_flush = (depth > eps_power(z, 5 / 8)) & (depth <= mechanics.flush_tolerance)
    in_front = ~mechanics.may_be_behind | lie_before_link(mechanics, at.gap, mechanics.flush_tolerance)
    flush_depth = jnp.where(is_flush & in_front, depth, 0.0)
    sense = jnp.where(target.until_value < z[target.until_coordinate], -1.0, 1.0)
    of_target = jnp.where(until, sense * target.until_value, 1.0)
    may_part = (jnp.abs(depth) < CORNER_TOL) & hold_same_tip(pairs, at, held, at_held).any(1)
    one, none, far = jnp.ones_like(held.lower), jnp.zeros_like(held.lower), jnp.full_like(held.lower, jnp.inf)
    every, nothing, of_links = jnp.ones_like(pairs.lower), jnp.zeros_like(pairs.lower), jnp.zeros_like(links.gap)

    def rows(of_pairs, before, behind, of_coordinate, of_links):
        return jnp.concatenate([of_pairs, before, behind, jnp.reshape(of_coordinate, 1), of_links])

    held = eqx.tree_at(lambda c: c.is_away, held, None, is_leaf=lambda leaf: leaf is None)  # their limits say so
    contacts = jax.tree.map(
        lambda a, b, c: rows(a, b, b, b[0], c),
        *(_with_carrier(each) for each in (pairs, held, links.contacts)),
    )
    return EventFunctions(
        contacts=contacts,
        gap=rows(every, none, none, 0.0, links.gap),
        along=rows(nothing, one, -one, 0.0, of_links),
        coordinate_weight=rows(nothing, none, none, jnp.where(until, -sense, 0.0), of_links),
        joint_angle=(
            rows(nothing, none, none, 0.0, links.joint_angle[0]),
            rows(nothing, none, none, 0.0, links.joint_angle[1]),
        ),
        shift=rows(flush_depth, -held.lower, held.upper, of_target, links.shift),
        coordinate=target.until_coordinate,
        lower=rows(pairs.lower, -far, -far, -jnp.inf, links.contacts.lower),
        upper=rows(pairs.upper, far, far, jnp.inf, links.contacts.upper),
        half_width=rows(nothing, none, none, 0.0, links.half_width),
        is_terminal=rows(mechanics.may_terminate, one > 0, one > 0, True, links.exists),
        two_sided=rows(mechanics.may_be_behind, one < 0, one < 0, False, links.two_sided),
        may_part=rows(may_part, one < 0, one < 0, False, links.exists & False),
    )


def _with_carrier(contacts: ContactSet) -> ContactSet:
    """Say of every row that the object carries it, unless it says otherwise."""
    if contacts.carrier is not None:
        return contacts
    none = jnp.zeros_like(contacts.lower)
    carrier = Carrier(none + 1, (none, none), (none, none))
    return eqx.tree_at(lambda c: c.carrier, contacts, carrier, is_leaf=lambda leaf: leaf is None)


def first_event(crossed: Bool[Array, "rows"], fraction: Float[Array, "rows"]) -> Int[Array, ""]:
    """Choose the event that is met first: of several within rounding of one another, the one that stands first."""
    where = jnp.where(crossed, fraction, jnp.inf)
    return jnp.argmax(where <= where.min() + COINCIDENT_FRACTION)


def detect_events(events: EventFunctions, before: EventValues, after: EventValues, step, tolerance):
    """Detect which values turn negative within a step (or dip below zero and return), and at which fraction of it.

    The fraction is a root of the cubic through values and rates: several events within the shortest step
    are told apart to 1e-13.
    """
    # A vertex behind a link, within its length, stops at its back; one misplaced there comes out.
    sense = jnp.where((before.values < -tolerance) & events.two_sided, -1.0, 1.0)
    old, new = sense * before.values - events.half_width, sense * after.values - events.half_width
    leaving, arriving = sense * before.rates, sense * after.rates
    # From either side what is within the tolerance counts as in front.
    parts = events.may_part & (jnp.abs(before.values) <= tolerance)
    through = (old >= -tolerance) & (new < -sense * tolerance) & ~parts
    slope = jnp.where(arriving > leaving, arriving - leaving, 1.0)
    turns = (leaving < 0) & (arriving > 0) & (old >= -tolerance) & ~parts
    # What touches already has rates by rounding, too: it sinks where it comes below its tolerance.
    sinks = turns & (old - step * leaving**2 / (2 * slope) < jnp.where(old > tolerance, 0.0, -tolerance))
    dips = sinks & (new > tolerance)

    def placed():
        """Most steps cross nothing: there all this is left out."""
        line = jnp.clip(old / jnp.where(through, old - new, 1.0), 0.0, 1.0)
        bend = jnp.sqrt(jnp.where(sinks, leaving**2 - 2 * jnp.maximum(old, 0.0) * slope / step, 0.0))
        # What comes back is met on its way down.
        where = jnp.where(through & ~sinks, line, (-leaving - bend) / slope)
        low, high = step * leaving, step * arriving
        square, cube = 3 * (new - old) - 2 * low - high, low + high - 2 * (new - old)
        for _ in range(2):
            rate = low + where * (2 * square + 3 * where * cube)
            better = where - (old + where * (low + where * (square + where * cube))) / jnp.where(rate < 0, rate, -1.0)
            where = jnp.where((rate < 0) & (better >= 0) & (better <= 1), better, where)
        at = before.along + (after.along - before.along) * where
        inside = (at >= events.lower - tolerance) & (at <= events.upper + tolerance)
        return (through | dips) & inside & events.is_terminal, where

    return jax.lax.cond(jnp.any(through | dips), placed, lambda: (through & dips, jnp.zeros_like(old)))
