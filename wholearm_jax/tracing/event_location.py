"""Places on a wire: its end and its kinks, each where something vanishes, and whether the wire meets another one.

Derivation: section 3 of `docs/derivation.md`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float, Int

from wholearm_jax.core.arrays import eps_power
from wholearm_jax.core.lookup import take_row
from wholearm_jax.model.contact_kinematics import contact_kinematics, slip_velocity_at
from wholearm_jax.tracing.continuation import BRACKET_STEP, TracedCurve, oriented_tangent
from wholearm_jax.tracing.path_root import solve_on_path


class EventPoints(NamedTuple):
    """The wire's end and its kinks in order, with their tangents `x`; `s` is infinite for unused rows."""

    z: Float[Array, "places 5"]
    x: Float[Array, "places 5"]
    s: Float[Array, "places"]
    chart: Int[Array, "places"]
    end: Float[Array, "5"]
    end_s: Float[Array, ""]
    branched: Bool[Array, ""]
    failed: Bool[Array, ""]


_CHART_PLANE, _PATH_END = 6, 7  # what vanishes: 0-3 slip of a contact, 4-5 speed of a joint, then these


def locate_events(system, heading, marched: TracedCurve, most: int) -> EventPoints:
    """Sharpen the bracketed end and every sign change of slips and joint speeds to rounding level: `most` places."""
    fixed = stop_gradient(system)
    last = jnp.maximum(marched.n - 1, 0)
    (found,) = jnp.nonzero(marched.nodes.flips.ravel(), size=most - 1, fill_value=-1)
    used = jnp.append(found >= 0, True)
    segment = jnp.append(jnp.where(found >= 0, found // 7, 0), last)
    what = jnp.append(jnp.where(found >= 0, found % 7, _CHART_PLANE), _PATH_END)
    fraction = marched.nodes.share[segment, jnp.minimum(what, _CHART_PLANE)][:, None]
    guess = marched.nodes.z[segment - 1] * (1 - fraction) + marched.nodes.z[segment] * fraction
    guess = jnp.where(used[:, None], guess, marched.nodes.z[0]).at[-1].set(marched.end_z)

    # A chart ends at the node before the first step in the next one.
    chart = marched.nodes.chart[jnp.maximum(segment - (what == _CHART_PLANE), 0)]

    def locate(row):
        used, segment, what, guess, chart = row
        hint = take_row(marched.nodes.x, jnp.maximum(segment - 1, 0))

        def vanishing(system, z, x, heading):
            return _event_residuals(system, heading, marched, z, x, hint @ (z - guess))[what]

        def sharp():
            root = solve_on_path(vanishing, system, guess, hint, heading)
            return root.z, root.x, root.residual, path_coordinate(marched, chart, root.z)

        none = jnp.zeros_like(guess[0])
        return jax.lax.cond(used, sharp, lambda: (guess, hint, none, none))

    # One after the other: most wires have few.
    z, x, residual, s = jax.lax.map(locate, (used, segment, what, guess, chart))
    slack = jnp.where(what == _PATH_END, 4 * BRACKET_STEP, eps_power(z, 3 / 8))
    before = jnp.where(segment > 0, marched.nodes.s[jnp.maximum(segment - 1, 0)], 0.0)
    astray = (residual > eps_power(z, 1 / 2)) | (s < before - slack) | (s > marched.nodes.s[segment] + slack)
    failed = jnp.any(used & astray)
    kinks = jnp.where(used[:-1], s[:-1], jnp.inf)
    rank = jnp.argsort(stop_gradient(kinks))
    branched = _has_bifurcation(fixed, marched, stop_gradient(z[-1]), astray[-1])
    return EventPoints(z[rank], x[rank], kinks[rank], chart[rank], z[-1], s[-1], branched, failed)


def _event_residuals(system, heading, marched, z, x, ahead_of_guess):
    """What may fix a place on the wire by vanishing there: `reversal_functions`, the way from the guess, what ends the wire."""
    pairs, slots = system.candidates.lower.shape[0], system.contacts.lower.shape[0]
    made = jnp.clip(marched.end, 0, pairs - 1)
    several = jax.tree.map(lambda a, b: jnp.append(a, take_row(b, made)[None], axis=0), system.contacts, system.candidates)
    at = contact_kinematics(several, z)
    room = [(at.along - several.lower)[:slots], (several.upper - at.along)[:slots]]
    ahead = heading.until_value - take_row(z, jnp.maximum(heading.until_coordinate, 0))
    others = jnp.concatenate([*room, ahead[None]])
    ending = jnp.where(marched.end < pairs, at.gap[slots], take_row(others, jnp.maximum(marched.end - pairs, 0)))
    ending = jnp.where(marched.end < 0, ahead_of_guess, ending)
    return jnp.concatenate([slip_velocity_at(several, at, x)[:slots], x[3:], jnp.stack([ahead_of_guess, ending])])


def _has_bifurcation(system, marched, end, astray):
    """Whether the wire meets another one on its way: `det [G; x]` changes sign."""
    rows, last = jnp.arange(marched.nodes.s.shape[0]), jnp.maximum(marched.n - 1, 0)
    # The last node lies a little beyond the end: it counts only if the end was not found.
    _, at_end = oriented_tangent(system, end, marched.nodes.x[jnp.maximum(last - 1, 0)])
    along = jnp.where((rows == last) & ~astray, at_end, marched.nodes.orientation)
    live = (rows < marched.n) & (rows > 0) & (marched.end >= 0)
    size = jnp.abs(jnp.where(live, along, along[0])).max()
    # Where two wires meet, Newton's method finds the end to half of the digits only.
    return jnp.any(live & (along * jnp.sign(along[0]) < eps_power(end, 3 / 8) * size))


def path_coordinate(marched: TracedCurve, chart, z):
    """Where along the wire `z` is, by one of its charts."""
    charts = marched.charts
    return charts.anchor_s[chart] + charts.direction[chart] @ (z - charts.anchor[chart])
