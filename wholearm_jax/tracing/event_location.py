"""Places on a wire: its end and its kinks, each where something vanishes, and whether the wire meets another one.

Derivation: section 3 of `docs/derivation.md`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float, Int

from wholearm_jax.core import eps_power, take_row
from wholearm_jax.model import contact_kinematics, slip_velocity_at
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
    has_bifurcation: Bool[Array, ""]
    failed: Bool[Array, ""]


_CHART_PLANE, _PATH_END = 6, 7  # what vanishes: 0-3 slip of a contact, 4-5 speed of a joint, then these


def locate_events(mechanics, target, curve: TracedCurve, most: int) -> EventPoints:
    """Sharpen the bracketed end and every sign change of slips and joint speeds to rounding level: `most` places."""
    fixed = stop_gradient(mechanics)
    last = jnp.maximum(curve.n - 1, 0)
    (found,) = jnp.nonzero(curve.nodes.sign_changed.ravel(), size=most - 1, fill_value=-1)
    used = jnp.append(found >= 0, True)
    march_step = jnp.append(jnp.where(found >= 0, found // 7, 0), last)
    what = jnp.append(jnp.where(found >= 0, found % 7, _CHART_PLANE), _PATH_END)
    fraction = curve.nodes.change_fraction[march_step, jnp.minimum(what, _CHART_PLANE)][:, None]
    guess = curve.nodes.z[march_step - 1] * (1 - fraction) + curve.nodes.z[march_step] * fraction
    guess = jnp.where(used[:, None], guess, curve.nodes.z[0]).at[-1].set(curve.end_z)

    # A chart ends at the node before the first step in the next one.
    chart = curve.nodes.chart[jnp.maximum(march_step - (what == _CHART_PLANE), 0)]

    def locate(row):
        used, march_step, what, guess, chart = row
        hint = take_row(curve.nodes.x, jnp.maximum(march_step - 1, 0))

        def vanishing(mechanics, z, x, target):
            return _event_residuals(mechanics, target, curve, z, x, hint @ (z - guess))[what]

        def sharp():
            root = solve_on_path(vanishing, mechanics, guess, hint, target)
            return root.z, root.x, root.residual, path_coordinate(curve, chart, root.z)

        none = jnp.zeros_like(guess[0])
        return jax.lax.cond(used, sharp, lambda: (guess, hint, none, none))

    # One after the other: most wires have few.
    z, x, residual, s = jax.lax.map(locate, (used, march_step, what, guess, chart))
    slack = jnp.where(what == _PATH_END, 4 * BRACKET_STEP, eps_power(z, 3 / 8))
    before = jnp.where(march_step > 0, curve.nodes.s[jnp.maximum(march_step - 1, 0)], 0.0)
    unresolved = (residual > eps_power(z, 1 / 2)) | (s < before - slack) | (s > curve.nodes.s[march_step] + slack)
    failed = jnp.any(used & unresolved)
    kinks = jnp.where(used[:-1], s[:-1], jnp.inf)
    rank = jnp.argsort(stop_gradient(kinks))
    branched = _has_bifurcation(fixed, curve, stop_gradient(z[-1]), unresolved[-1])
    return EventPoints(z[rank], x[rank], kinks[rank], chart[rank], z[-1], s[-1], branched, failed)


def _event_residuals(mechanics, target, curve, z, x, ahead_of_guess):
    """What may fix a place on the wire by vanishing there: `reversal_functions`, the way from the guess, what ends the
    wire."""
    pairs, slots = mechanics.candidates.lower.shape[0], mechanics.contacts.lower.shape[0]
    made = jnp.clip(curve.end, 0, pairs - 1)
    contacts = jax.tree.map(
        lambda a, b: jnp.append(a, take_row(b, made)[None], axis=0), mechanics.contacts, mechanics.candidates
    )
    at = contact_kinematics(contacts, z)
    room = [(at.along - contacts.lower)[:slots], (contacts.upper - at.along)[:slots]]
    ahead = target.until_value - take_row(z, jnp.maximum(target.until_coordinate, 0))
    others = jnp.concatenate([*room, ahead[None]])
    ending = jnp.where(curve.end < pairs, at.gap[slots], take_row(others, jnp.maximum(curve.end - pairs, 0)))
    ending = jnp.where(curve.end < 0, ahead_of_guess, ending)
    return jnp.concatenate([slip_velocity_at(contacts, at, x)[:slots], x[3:], jnp.stack([ahead_of_guess, ending])])


def _has_bifurcation(mechanics, curve, end, failed):
    """Whether the wire meets another one on its way: `det [G; x]` changes sign."""
    rows, last = jnp.arange(curve.nodes.s.shape[0]), jnp.maximum(curve.n - 1, 0)
    # The last node lies a little beyond the end: it counts only if the end was not found.
    _, at_end = oriented_tangent(mechanics, end, curve.nodes.x[jnp.maximum(last - 1, 0)])
    along = jnp.where((rows == last) & ~failed, at_end, curve.nodes.orientation)
    live = (rows < curve.n) & (rows > 0) & (curve.end >= 0)
    size = jnp.abs(jnp.where(live, along, along[0])).max()
    # Where two wires meet, Newton's method finds the end to half of the digits only.
    return jnp.any(live & (along * jnp.sign(along[0]) < eps_power(end, 3 / 8) * size))


def path_coordinate(curve: TracedCurve, chart, z):
    """Where along the wire `z` is, by one of its charts."""
    charts = curve.charts
    return charts.anchor_s[chart] + charts.direction[chart] @ (z - charts.anchor[chart])
