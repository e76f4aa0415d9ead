r"""Watch: what may end a wire, as rows of one table, and which of them a step of the march crosses.

Gaps of contacts that might be made, room on the features of those that hold, a coordinate's limit: each ends the wire
where it turns negative, or dips below zero and returns within a step; a vertex behind a finger where its gap turns
positive. All are the same function of a contact, with weights of their own,

    value = a gap + b along + c z_k + shift,

so that a step computes them side by side.

Derivation: section 3 of `docs/derivation.md`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from wholearm_jax.model import (
    ContactSet,
    PathTarget,
    ScaledMechanics,
    contact_kinematics,
    feature_velocity,
    gap_velocity,
)


class EventValues(NamedTuple):
    """Values that stay positive on a wire, their rates `d/ds`, and places along features."""

    values: Float[Array, "rows"]
    rates: Float[Array, "rows"]
    along: Float[Array, "rows"]


class EventFunctions(NamedTuple):
    """What is watched: all pairs that may touch (`ScaledMechanics.candidates`), room before and behind each contact on
    its
    feature, and a coordinate's limit.

    `gap`, `along`, `limit` and `shift` are the weights of a row's value. A pair ends the wire within `[lower, upper]`
    of its feature, and if it `is_terminal`; `may_start_negative` marks vertices that may lie behind a link.
    """

    contacts: ContactSet
    gap: Float[Array, "rows"]
    along: Float[Array, "rows"]
    limit: Float[Array, "rows"]
    shift: Float[Array, "rows"]
    coordinate: Int[Array, ""]
    lower: Float[Array, "rows"]
    upper: Float[Array, "rows"]
    is_terminal: Bool[Array, "rows"]
    may_start_negative: Bool[Array, "rows"]

    def at(self, z: Float[Array, "5"], slope: Float[Array, "5"]) -> EventValues:
        """What is watched at a place of the wire, where `z` changes by `slope` a unit of `s`."""
        here = contact_kinematics(self.contacts, z)
        return EventValues(
            values=self.gap * here.gap + self.along * here.along + self.limit * z[self.coordinate] + self.shift,
            rates=self.gap * gap_velocity(self.contacts, z, slope)
            + self.along * feature_velocity(self.contacts, z, slope)
            + self.limit * slope[self.coordinate],
            along=here.along,
        )


def event_functions(mechanics: ScaledMechanics, target: PathTarget, z: Float[Array, "5"]) -> EventFunctions:
    """What is watched on a formation's wire from `z` on."""
    pairs, held, until = mechanics.candidates, mechanics.contacts, target.until_coordinate >= 0
    sense = jnp.where(target.until_value < z[target.until_coordinate], -1.0, 1.0)
    one, none, far = jnp.ones_like(held.lower), jnp.zeros_like(held.lower), jnp.full_like(held.lower, jnp.inf)
    every, nothing = jnp.ones_like(pairs.lower), jnp.zeros_like(pairs.lower)

    def rows(of_pairs, before, behind, of_limit):
        return jnp.concatenate([of_pairs, before, behind, jnp.reshape(of_limit, 1)])

    return EventFunctions(
        contacts=jax.tree.map(lambda a, b: rows(a, b, b, b[0]), pairs, held),
        gap=rows(every, none, none, 0.0),
        along=rows(nothing, one, -one, 0.0),
        limit=rows(nothing, none, none, jnp.where(until, -sense, 0.0)),
        shift=rows(nothing, -held.lower, held.upper, jnp.where(until, sense * target.until_value, 1.0)),
        coordinate=target.until_coordinate,
        lower=rows(pairs.lower, -far, -far, -jnp.inf),
        upper=rows(pairs.upper, far, far, jnp.inf),
        is_terminal=rows(mechanics.may_terminate, one > 0, one > 0, True),
        may_start_negative=rows(mechanics.may_be_behind, one < 0, one < 0, False),
    )


def detect_events(events: EventFunctions, before: EventValues, after: EventValues, step, tolerance):
    """Which watched values turn negative within a step (or dip below zero and return), and at what share of it.

    The share is a root of the cubic through values and rates: several things that end a wire within the shortest step
    are told apart to 1e-13.
    """
    # A vertex behind a link, within its length, stops at its back; one misplaced there comes out.
    sense = jnp.where((before.values < -tolerance) & events.may_start_negative, -1.0, 1.0)
    old, new, leaving, arriving = sense * before.values, sense * after.values, sense * before.rates, sense * after.rates
    # From either side what is within the tolerance counts as in front.
    through = (old >= -tolerance) & (new < -sense * tolerance)
    slope = jnp.where(arriving > leaving, arriving - leaving, 1.0)
    turns = (leaving < 0) & (arriving > 0) & (old > tolerance)
    sinks = turns & (old - step * leaving**2 / (2 * slope) < 0)
    dips = sinks & (new > tolerance)

    def placed():
        """Most steps cross nothing: there all this is left out."""
        line = jnp.clip(old / jnp.where(through, old - new, 1.0), 0.0, 1.0)
        bend = jnp.sqrt(jnp.where(sinks, leaving**2 - 2 * old * slope / step, 0.0))
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
