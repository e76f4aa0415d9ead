r"""Trace: the curve `z(s)` on which a formation of four constraints moves, its ends, kinks and nodes.

Four C-functions (gaps, and the places where rolling contacts touch) in five unknowns leave a wire that depends on
geometry alone. It is charted by the linear coordinate
`s = s_ref + u . (z - z_ref)` (object units, see `system`), `u` being the unit tangent where the chart begins; a wire
that turns away from `u` continues in a new chart, so turning points of single coordinates are nothing special. The
search for its end and its kinks (`march`) runs on constants; at every place that it finds something vanishes on the
wire, from which derivatives follow (`newton`).

A wire is cut into *pieces* where a contact's slip or a joint's speed reverses, or the chart changes: within a piece
everything is smooth. Pieces are cut into panels with Chebyshev nodes, at which `reduction` tabulates.

Derivation: section 3 of `docs/derivation.md`.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.lax import stop_gradient
from jaxtyping import Array, Float, Int

from wholearm_jax.core.arrays import array, digits
from wholearm_jax.core.small_linalg import times
from wholearm_jax.core.status import Status
from wholearm_jax.model.contact_kinematics import constraint_rows, constraints, placed
from wholearm_jax.model.mechanics import System
from wholearm_jax.model.scene import Heading
from wholearm_jax.tracing.continuation import correct, march, signs_of, speeds_of
from wholearm_jax.tracing.event_location import coordinate, places_of
from wholearm_jax.tracing.projection import dependent, leading, misplaced, oriented, project

NO_END, MADE, LEFT, UNTIL = range(4)  # why a wire ends


class Resolution(NamedTuple):
    """Sizes of a wire's table: at most `pieces` smooth pieces, `panels` panels in all, `nodes` Chebyshev nodes each.

    `march` is how many steps, 0.06 radians or object radii each, follow a wire to its end.
    """

    pieces: int = 6
    panels: int = 64
    nodes: int = 8
    march: int = 256


class Pieces(eqx.Module):
    """The smooth pieces of a wire, and the charts that they lie in. Those beyond `count` are empty and lie at its end.

    Piece `k` covers `[breaks[k], breaks[k + 1]]` in the chart `chart[k]` about (`anchor[k]`, `anchor_s[k]`), and
    `factor[k]` is the ratio of `ds/dt` after entering the piece to that before.
    """

    count: Int[Array, ""]
    breaks: Float[Array, "pieces_1"]
    chart: Float[Array, "pieces 5"]
    anchor: Float[Array, "pieces 5"]
    anchor_s: Float[Array, "pieces"]
    factor: Float[Array, "pieces"]


class Wire(Pieces):
    """A traced wire in object units: its pieces, their panels and nodes, and how it ends.

    `slip_sign` (Xi) and `joint_sign` hold
    for forward travel. Panels `first[k] ... first[k] + panels[k] - 1` belong to piece `k`; `nodes[p, i]` is `z` at node
    `i` of panel `p`. `end_why` says why the wire ends and `end_contact` which contact is made (a row of
    `System.candidates`) or leaves its feature (a row of `System.contacts`).
    """

    status: Int[Array, ""]
    start: Float[Array, "5"]
    end: Float[Array, "5"]
    end_why: Int[Array, ""]
    end_contact: Int[Array, ""]
    slip_sign: Float[Array, "pieces slots"]
    joint_sign: Float[Array, "pieces 2"]
    first: Int[Array, "pieces"]
    panels: Int[Array, "pieces"]
    owner: Int[Array, "panels"]
    nodes: Float[Array, "panels nodes 5"]

    @property
    def length(self) -> Float[Array, ""]:
        """The wire's extent in `s`."""
        return self.breaks[-1] - self.breaks[0]


def trace_wire(system: System, rough: Float[Array, "5"], heading: Heading, resolution: Resolution) -> Wire:
    """Project `rough` (SI) onto the formation and follow its wire as `heading` says, to its end.

    Never raises for a configuration that does not work: `Wire.status` says `no_convergence` (the contacts cannot all
    touch near the start), `left_formation` (there a contact is beyond its feature, or the object inside a link),
    `singular` (fold or branch), `max_steps` (no end within reach) or `ok`.
    """
    rough = rough / system.configuration_unit
    until = heading.until_value / system.configuration_unit[heading.until_coordinate]
    heading = eqx.tree_at(lambda h: h.until_value, heading, until)
    system = eqx.tree_at(lambda s: s.contacts, system, placed(system.contacts, rough))
    fixed, fixed_heading = stop_gradient(system), stop_gradient(heading)

    start, residual, along = project(system, rough)
    first_tangent = oriented(along, fixed_heading)
    marched = march(fixed, fixed_heading, stop_gradient(start), first_tangent, resolution.march)
    places = places_of(system, heading, marched, resolution.pieces)
    wire = _cut(system, fixed, marched, places, start, resolution)
    touching = residual < 100 * jnp.finfo(rough.dtype).eps
    tied = ~touching & dependent(fixed, stop_gradient(rough))
    direction = jnp.abs(first_tangent[leading(heading, first_tangent)]) > 1e-6
    worst = jnp.select(
        [
            tied,
            ~touching,
            misplaced(fixed, stop_gradient(start)),
            ~direction,
            marched.status > 0,
            places.branched,
            places.failed | wire.status.astype(bool),
        ],
        [
            int(Status.SINGULAR),
            int(Status.NO_CONVERGENCE),
            int(Status.LEFT_FORMATION),
            int(Status.SINGULAR),
            marched.status,
            int(Status.SINGULAR),
            int(Status.NO_CONVERGENCE),
        ],
        0,
    )
    return eqx.tree_at(lambda w: w.status, wire, worst)


def blank(resolution: Resolution, contacts: int = 4) -> Wire:
    """A wire of the right shapes that was not found: something to compile with."""
    pieces, panels, nodes, _ = resolution
    each = {name: np.zeros((pieces, 5)) for name in ("chart", "anchor")}
    each |= {name: np.zeros(pieces) for name in ("anchor_s", "factor")}
    each |= {name: np.zeros(5) for name in ("start", "end")}
    each |= {"slip_sign": np.zeros((pieces, contacts)), "joint_sign": np.zeros((pieces, 2))}
    each |= {"breaks": np.arange(pieces + 1.0), "nodes": np.zeros((panels, nodes, 5))}
    each |= {"first": np.zeros(pieces, int), "panels": np.ones(pieces, int), "owner": np.zeros(panels, int)}
    each |= {"count": 1, "status": int(Status.NO_CONVERGENCE), "end_why": NO_END, "end_contact": 0}
    return Wire(**{name: array(value) for name, value in each.items()})


def chebyshev(nodes: int) -> np.ndarray:
    """Chebyshev points of the first kind on [-1, 1], increasing."""
    return -np.cos(np.pi * (np.arange(nodes) + 0.5) / nodes)


def _lay(marched, places, start, resolution) -> Pieces:
    """Cut the wire into its pieces, each in the chart that it is charted by."""
    # A kink at the end cuts off no piece: in one so short forces vary by rounding alone, and so would the place of the
    # least and the derivatives there.
    before_end = stop_gradient(places.s) < stop_gradient(places.end_s) - digits(places.end_s, 5 / 8)
    inside = jnp.isfinite(places.s) & before_end
    count = inside.sum() + 1
    last = marched.nodes.chart[jnp.maximum(marched.n - 1, 0)]
    # Piece k ends at place k, which lies in the chart of the segment before it.
    owner_chart = jnp.append(jnp.where(inside, places.chart, last), last)
    directions = marched.charts.direction
    chart, anchor = directions[owner_chart], marched.charts.anchor[owner_chart]
    entry = jnp.concatenate([start[None], places.z])
    live = jnp.arange(resolution.pieces) < count

    # Two charts give the place where they meet the same `s`, also where that place moves with the scene.
    before = jnp.concatenate([owner_chart[:1], owner_chart[:-1]])
    by_chart = jax.vmap(coordinate, (None, 0, 0))
    jump = jnp.where(live, by_chart(marched, before, entry) - by_chart(marched, owner_chart, entry), 0.0)
    shift = jnp.cumsum(jump)
    anchor_s = marched.charts.anchor_s[owner_chart] + shift
    end_s = places.end_s + shift[-1]
    kinks = jnp.where(inside, jnp.where(inside, places.s, 0.0) + shift[:-1], end_s)
    breaks = jnp.concatenate([coordinate(marched, 0, start)[None], kinks, end_s[None]])

    old = directions[before]
    before_entry = jnp.where(live[1:], (old[1:] * places.x).sum(1), 1.0)
    factor = jnp.append(1.0, jnp.where(live[1:], (chart[1:] * places.x).sum(1) / before_entry, 1.0))
    return Pieces(count, breaks, chart, anchor, anchor_s, factor)


def _cut(system, fixed, marched, places, start, resolution):
    """Lay panels over the pieces and solve the C-functions at every node."""
    laid = _lay(marched, places, start, resolution)
    first, panels, owner = _panels(stop_gradient(laid.breaks), laid.count, resolution)
    local = (jnp.arange(resolution.panels) - first[owner])[:, None] + (chebyshev(resolution.nodes) + 1) / 2
    low, high = laid.breaks[owner][:, None], laid.breaks[owner + 1][:, None]
    s = low + (high - low) * local / panels[owner][:, None]
    guess = _interpolate(marched, stop_gradient(s), laid.chart[owner])

    def node(s, guess, u, anchor, anchor_s):
        height = u @ anchor + s - anchor_s
        z, moved, inverted, _ = correct(fixed, u, guess, stop_gradient(height), 2, digits(guess, 3 / 8))

        def equations(z, system, height):
            return jnp.concatenate([constraints(system.contacts, z), (u @ z - height)[None]])

        found = z - times(stop_gradient(inverted), equations(stop_gradient(z), system, height))
        here = stop_gradient(found)
        return found, moved, speeds_of(fixed, here, _refined(fixed, here, u, inverted))

    per_panel = jax.vmap(node, (0, 0, None, None, None))
    nodes, moved, speeds = jax.vmap(per_panel)(s, guess, laid.chart[owner], laid.anchor[owner], laid.anchor_s[owner])
    slip_sign, joint_sign, missed = _signs(stop_gradient(speeds), owner, resolution)
    pairs = system.candidates.lower.shape[0]
    contact = jnp.where(marched.end < pairs, marched.end, (marched.end - pairs) % 4)
    why = jnp.select([marched.end < 0, marched.end < pairs, marched.end < pairs + 8], [NO_END, MADE, LEFT], UNTIL)
    return Wire(
        status=(missed | (moved.max() > digits(nodes, 3 / 8))).astype(int),
        start=start,
        end=places.end,
        end_why=why,
        end_contact=contact,
        slip_sign=slip_sign,
        joint_sign=joint_sign,
        first=first,
        panels=panels,
        owner=owner,
        nodes=nodes,
        **vars(laid),
    )


def _refined(system, z, u, inverted):
    """`dz/ds` in the chart `u`: the last column of `[G; u]^-1`, with an inverse from nearby mended by one step."""
    x = inverted[:, 4]
    rows = jnp.concatenate([constraint_rows(system.contacts, z), u[None]])
    return x + times(inverted, jnp.zeros(5, z.dtype).at[4].set(1.0) - times(rows, x))


def _panels(breaks, count, resolution):
    """Share the panels among the pieces by length, at least one each."""
    lengths = jnp.diff(breaks)
    live = jnp.arange(resolution.pieces) < count
    spare = resolution.panels - count
    share = jnp.floor(spare * jnp.where(live, lengths, 0.0) / jnp.maximum(lengths.sum(), 1e-30)).astype(int)
    panels = jnp.where(live, 1 + share, 0)
    longest = jnp.arange(resolution.pieces) == jnp.argmax(lengths)
    panels = panels + jnp.where(longest, resolution.panels - panels.sum(), 0)  # what rounding leaves over
    first = jnp.concatenate([jnp.zeros(1, int), jnp.cumsum(panels)[:-1]])
    owner = (jnp.arange(resolution.panels)[:, None] >= jnp.cumsum(panels)).sum(1)
    return first, panels, owner


def _interpolate(marched, s, u):
    """Cubic Hermite guess of `z` at every `s` from the march's nodes."""
    nodes = marched.nodes
    right = jnp.clip((nodes.s < s[..., None]).sum(-1), 1, jnp.maximum(marched.n - 1, 1))
    left = right - 1
    width = nodes.s[right] - nodes.s[left]
    width = jnp.where(jnp.isfinite(width) & (width > 0), width, 1.0)[..., None]
    f = ((s - nodes.s[left])[..., None]) / width
    slope = [nodes.x[k] / jnp.einsum("pni,pi->pn", nodes.x[k], u)[..., None] * width for k in (left, right)]
    low, high = nodes.z[left], nodes.z[right]
    return (
        low * (1 + 2 * f) * (1 - f) ** 2
        + high * f**2 * (3 - 2 * f)
        + slope[0] * f * (1 - f) ** 2
        + slope[1] * f**2 * (f - 1)
    )


def _signs(values, owner, resolution):
    """Signs of slips and joint speeds of each piece, and whether any node contradicts its piece's sign.

    What is smooth and zero throughout a piece is zero on the whole wire. Where only a piece is too short to tell, as
    between kinks that meet, what it adjoins holds: the piece before it, or behind it at the start.
    """
    tolerance, piece = digits(values, 5 / 8), jnp.arange(resolution.pieces)
    total = jnp.where((owner == piece[:, None])[..., None], values.sum(1), 0.0).sum(1)
    signs = signs_of(total, tolerance)
    away = piece[:, None] - piece
    away = jnp.where(away >= 0, away, resolution.pieces - away)
    told_by = jnp.argmin(jnp.where(signs != 0, away[..., None], 2 * resolution.pieces), axis=1)
    signs = jnp.take_along_axis(signs, told_by, axis=0)
    missed = jnp.any(values * signs[owner][:, None] < -tolerance) | ~jnp.all(jnp.isfinite(values))
    return signs[:, :4], signs[:, 4:], missed
