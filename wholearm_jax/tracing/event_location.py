"""Location of a path's end and kinks to rounding level, and detection of bifurcations.

Derivation: section 3 of `docs/derivation.md`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float, Int

from wholearm_jax.core import eps_power, take_row
from wholearm_jax.model import ScaledMechanics, slip_velocity
from wholearm_jax.tracing.continuation import BRACKET_STEP
from wholearm_jax.tracing.curve import TracedCurve, oriented_tangent, path_coordinate
from wholearm_jax.tracing.events import EventFunctions
from wholearm_jax.tracing.path_root import solve_on_path


class EventPoints(NamedTuple):
    """A path's kinks in order along it, and its end."""

    z: Float[Array, "kinks 5"]  # configuration
    x: Float[Array, "kinks 5"]  # tangent dz/ds
    s: Float[Array, "kinks"]  # path coordinate; infinite in unused rows
    chart: Int[Array, "kinks"]  # chart of the segment before
    end: Float[Array, "5"]  # configuration at the end
    end_s: Float[Array, ""]  # path coordinate there
    has_bifurcation: Bool[Array, ""]
    failed: Bool[Array, ""]  # a point was not located within its bracket


class _EventGuesses(NamedTuple):
    """Where to search for the events: the kinks, then the end."""

    used: Bool[Array, "events"]
    node: Int[Array, "events"]  # the node after the event
    row: Int[Array, "events"]  # of the residuals: 0-3 slip of a contact, 4-5 speed of a joint, then the two below
    z: Float[Array, "events 5"]
    chart: Int[Array, "events"]


_CHART_CHANGE, _PATH_END = 6, 7


def locate_events(
    mechanics: ScaledMechanics, events: EventFunctions, curve: TracedCurve, max_events: int
) -> EventPoints:
    """Refine the bracketed end and every sign change of slips and joint speeds by Newton's method along the path."""
    guesses = _event_guesses(curve, max_events)
    terminal = _take_event(events, jnp.maximum(curve.end, 0))
    side = jnp.where(terminal.residual(curve.end_z, 0.0) < 0, -1.0, 1.0)

    def refine(guess: _EventGuesses):
        hint = take_row(curve.nodes.x, jnp.maximum(guess.node - 1, 0))

        def residual(mechanics, z, x, terminal):
            beyond_guess = hint @ (z - guess.z)
            end = jnp.where(curve.end < 0, beyond_guess, terminal.residual(z, side))
            slips = slip_velocity(mechanics.contacts, z, x)
            return jnp.concatenate([slips, x[3:], jnp.stack([beyond_guess, end])])[guess.row]

        def solve():
            root = solve_on_path(residual, mechanics, guess.z, hint, terminal)
            return root.z, root.x, root.residual, path_coordinate(curve, guess.chart, root.z)

        none = jnp.zeros_like(guess.z[0])
        return jax.lax.cond(guess.used, solve, lambda: (guess.z, hint, none, none))

    # One after the other: most paths have few events.
    z, x, residual, s = jax.lax.map(refine, guesses)
    unresolved = _leaves_bracket(curve, guesses, s) | (residual > eps_power(z, 1 / 2))
    kinks = jnp.where(guesses.used[:-1], s[:-1], jnp.inf)
    rank = jnp.argsort(stop_gradient(kinks))
    return EventPoints(
        z=z[rank],
        x=x[rank],
        s=kinks[rank],
        chart=guesses.chart[rank],
        end=z[-1],
        end_s=s[-1],
        has_bifurcation=_has_bifurcation(stop_gradient(mechanics), curve, stop_gradient(z[-1]), unresolved[-1]),
        failed=jnp.any(guesses.used & unresolved),
    )


def _event_guesses(curve: TracedCurve, max_events: int) -> _EventGuesses:
    """Collect the sign changes between nodes, and the end, with linear estimates of where they are."""
    last = jnp.maximum(curve.n - 1, 0)
    (change,) = jnp.nonzero(curve.nodes.sign_changed.ravel(), size=max_events - 1, fill_value=-1)
    used = jnp.append(change >= 0, True)
    node = jnp.append(jnp.where(change >= 0, change // 7, 0), last)
    row = jnp.append(jnp.where(change >= 0, change % 7, _CHART_CHANGE), _PATH_END)
    fraction = curve.nodes.change_fraction[node, jnp.minimum(row, _CHART_CHANGE)][:, None]
    z = curve.nodes.z[node - 1] * (1 - fraction) + curve.nodes.z[node] * fraction
    z = jnp.where(used[:, None], z, curve.nodes.z[0]).at[-1].set(curve.end_z)
    # A chart ends at the node before the first step in the next one.
    chart = curve.nodes.chart[jnp.maximum(node - (row == _CHART_CHANGE), 0)]
    return _EventGuesses(used, node, row, z, chart)


def _leaves_bracket(curve: TracedCurve, guesses: _EventGuesses, s) -> Bool[Array, "events"]:
    """Whether located events lie outside the steps in which they were detected."""
    slack = jnp.where(guesses.row == _PATH_END, 4 * BRACKET_STEP, eps_power(s, 3 / 8))
    before = jnp.where(guesses.node > 0, curve.nodes.s[jnp.maximum(guesses.node - 1, 0)], 0.0)
    return (s < before - slack) | (s > curve.nodes.s[guesses.node] + slack)


def _take_event(events: EventFunctions, row) -> EventFunctions:
    """Take one row of the terminal events."""
    coordinate = events.coordinate
    return jax.tree.map(lambda a: take_row(a, row), events._replace(coordinate=coordinate[None] + 0 * row))


def _has_bifurcation(mechanics, curve: TracedCurve, end, end_unresolved) -> Bool[Array, ""]:
    """Whether `det [G; x]` changes sign on the path."""
    rows, last = jnp.arange(curve.nodes.s.shape[0]), jnp.maximum(curve.n - 1, 0)
    # The last node lies a little beyond the end: it counts only if the end was not located.
    _, at_end = oriented_tangent(mechanics, end, curve.nodes.x[jnp.maximum(last - 1, 0)])
    orientation = jnp.where((rows == last) & ~end_unresolved, at_end, curve.nodes.orientation)
    live = (rows < curve.n) & (rows > 0) & (curve.end >= 0)
    size = jnp.abs(jnp.where(live, orientation, orientation[0])).max()
    # At a bifurcation Newton's method finds the end to half of the digits only.
    return jnp.any(live & (orientation * jnp.sign(orientation[0]) < eps_power(end, 3 / 8) * size))
