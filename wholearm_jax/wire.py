r"""Trace: the curve `z(s)` on which a formation of four constraints moves, its ends, kinks and nodes.

Four C-functions (gaps, and the places where rolling contacts touch) in five unknowns leave a wire that depends on
geometry alone. It is charted by the linear coordinate
`s = s_ref + u . (z - z_ref)` (object units, see `system`), `u` being the unit tangent where the chart begins; a wire
that turns away from `u` continues in a new chart, so turning points of single coordinates are nothing special. The
search for its end and its kinks (`march`) runs on constants; every place that it finds is then the root of five
equations in five unknowns, from which derivatives follow (`newton`).

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
from jaxtyping import Array, Bool, Float, Int

from wholearm_jax.contacts import constraint_rows, constraints, frames, placed
from wholearm_jax.elimination import inverse, solve, times
from wholearm_jax.march import SHORTEST, correct, digits, march, oriented_tangent, signs_of, speeds_of, tangent
from wholearm_jax.newton import newton
from wholearm_jax.scene import Heading
from wholearm_jax.status import Status
from wholearm_jax.system import System

NO_END, MADE, LEFT, UNTIL = range(4)  # why a wire ends


class Resolution(NamedTuple):
    """Sizes of a wire's table: at most `pieces` smooth pieces, `panels` panels in all, `nodes` Chebyshev nodes each.

    `march` is how many steps, 0.06 radians or object radii each, follow a wire to its end.
    """

    pieces: int = 6
    panels: int = 64
    nodes: int = 8
    march: int = 256


class Wire(eqx.Module):
    """A traced wire in object units. Pieces beyond `count` are empty and lie at the wire's end.

    Piece `k` covers `[breaks[k], breaks[k + 1]]` in the chart `chart[k]` about (`anchor[k]`, `anchor_s[k]`), and
    `factor[k]` is the ratio of `ds/dt` after entering the piece to that before. `slip_sign` (Xi) and `joint_sign` hold
    for forward travel. Panels `first[k] ... first[k] + panels[k] - 1` belong to piece `k`; `nodes[p, i]` is `z` at node
    `i` of panel `p`. `end_why` says why the wire ends and `end_contact` which contact is made (a row of
    `System.candidates`) or leaves its feature (a row of `System.contacts`).
    """

    status: Int[Array, ""]
    start: Float[Array, "5"]
    end: Float[Array, "5"]
    end_why: Int[Array, ""]
    end_contact: Int[Array, ""]
    residual: Float[Array, ""]
    start_gaps: Float[Array, "slots"]
    count: Int[Array, ""]
    breaks: Float[Array, "pieces_1"]
    chart: Float[Array, "pieces 5"]
    anchor: Float[Array, "pieces 5"]
    anchor_s: Float[Array, "pieces"]
    factor: Float[Array, "pieces"]
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
    touch near the start; `start_gaps` tells which stay open), `left_formation` (there a contact is beyond its feature,
    or the object inside a link), `singular` (fold or branch), `max_steps` (no end within
    reach) or `ok`.
    """
    rough = rough / system.configuration_unit
    until = heading.until_value / system.configuration_unit[heading.until_coordinate]
    heading = eqx.tree_at(lambda h: h.until_value, heading, until)
    system = eqx.tree_at(lambda s: s.contacts, system, placed(system.contacts, rough))
    fixed, fixed_heading = stop_gradient(system), stop_gradient(heading)

    start, residual = _project(system, rough)
    first_tangent = _oriented(fixed, stop_gradient(start), fixed_heading)
    marched = march(fixed, fixed_heading, stop_gradient(start), first_tangent, resolution.march)
    places = _places(system, heading, marched, resolution)
    wire = _cut(system, fixed, marched, places, start, resolution)
    touching = residual < 100 * jnp.finfo(rough.dtype).eps
    dependent = ~touching & _dependent(fixed, stop_gradient(rough))
    direction = jnp.abs(first_tangent[_leading(heading, first_tangent)]) > 1e-6
    worst = jnp.select(
        [
            dependent,
            ~touching,
            _misplaced(fixed, stop_gradient(start)),
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
    return eqx.tree_at(
        lambda w: (w.status, w.residual, w.start_gaps),
        wire,
        (worst, residual, constraints(fixed.contacts, start) * fixed.length),
    )


# --- the wire's start -------------------------------------------------------------------------------------------------


def _project(system, rough):
    """The wire's point nearest to the rough start: least-norm Newton steps to reach it, then Newton on nearness."""
    fixed, far = stop_gradient(system), stop_gradient(rough)

    def least(z):
        rows = constraint_rows(fixed.contacts, z)
        move = -times(rows.T, solve(times(rows, rows.T), constraints(fixed.contacts, z)))
        move = jnp.where(jnp.isfinite(move), move, 0.0)
        return z + move * jnp.minimum(1.0, 0.3 / jnp.maximum(jnp.abs(move).max(), 1e-30))

    z = jax.lax.fori_loop(0, 12, lambda _, z: least(z), far)
    hint = _null(fixed, z)

    def nearest(z, system, rough):
        return jnp.concatenate([constraints(system.contacts, z), (tangent(system, z, hint) @ (z - rough))[None]])

    root = newton(nearest, z, system, rough)
    near = jnp.where(root.residual < digits(z, 3 / 8), root.z, z)
    return near, jnp.abs(constraints(fixed.contacts, stop_gradient(near))).max()


def _misplaced(system, z):
    """Whether a contact lies beyond its feature, a vertex behind the palm, or a convex object on a finger or behind it.

    Behind a finger's line, vertices of a convex object may lie where the finger's tip touches an edge, not where a
    vertex touches the finger.
    """
    tolerance = digits(z, 5 / 8)
    held, pairs = frames(system.contacts, z), frames(system.candidates, z)
    beyond = (held.along < system.contacts.lower - tolerance) | (held.along > system.contacts.upper + tolerance)
    inside = (pairs.along > system.candidates.lower) & (pairs.along < system.candidates.upper)
    of_finger, held_by = system.candidates.finger > 0, (system.contacts.finger > 0) & system.contacts.on_link[:, None]
    faces = ~of_finger.any(1) | (system.convex & (of_finger & held_by.any(0)).any(1))  # in front of them all must be
    behind = system.watched & system.candidates.on_link & faces & inside & (pairs.gap < -tolerance)
    return jnp.any(beyond) | jnp.any(behind) | (system.convex & _pierced(system, z, pairs.gap, tolerance))


def _pierced(system, z, tip, tolerance):
    """Whether part of a finger's contact edge lies within a convex object: behind all of its edges."""
    several = system.candidates
    root = frames(eqx.tree_at(lambda c: c.reach, several, jnp.zeros_like(several.reach)), z).gap
    root, rise = root + tolerance, tip - root
    cross = -root / jnp.where(rise == 0, 1.0, rise)  # where, from root (0) to tip (1), an edge's line is crossed
    enter = jnp.where(rise < 0, cross, jnp.where((rise == 0) & (root > 0), jnp.inf, -jnp.inf))
    leave = jnp.where(rise > 0, cross, jnp.inf)

    def within(finger):
        edges = ~several.on_link & (several.finger[:, finger] > 0) & system.real
        first = jnp.where(edges, enter, -jnp.inf).max()
        last = jnp.where(edges, leave, jnp.inf).min()
        return jnp.minimum(last, 1.0) > jnp.maximum(first, 0.0)

    return within(0) | within(1)


def _dependent(system, z):
    """Whether the constraints depend on one another at `z`: their rows span no volume."""
    rows = constraint_rows(system.contacts, z)
    rows = rows / jnp.sqrt((rows**2).sum(1, keepdims=True))
    return inverse(times(rows, rows.T))[1] < digits(z, 3 / 4)


def _null(system, z):
    """The unit tangent at `z`, of either sense: the longest column of the projector onto what is orthogonal to `G`."""
    rows = constraint_rows(system.contacts, z)
    projector = jnp.eye(5, dtype=z.dtype) - times(rows.T, solve(times(rows, rows.T), rows))
    # The projector has half of the digits where rows are nearly dependent, which is enough for a hint.
    return tangent(system, z, projector[jnp.argmax(jnp.diag(projector))])


def _oriented(system, z, heading):
    """The unit tangent at `z` whose coordinate `heading.coordinate` has the sign asked for."""
    null = _null(system, z)
    return null * jnp.where(null[_leading(heading, null)] * heading.sign < 0, -1.0, 1.0)


def _leading(heading, x):
    """The coordinate that tells which way a wire goes."""
    return jnp.where(heading.coordinate < 0, jnp.argmax(jnp.abs(x)), heading.coordinate)


# --- ends and kinks, located as roots --------------------------------------------------------------------------------


class _Places(NamedTuple):
    """The wire's end and its kinks in order; `s` is infinite for unused rows."""

    z: Float[Array, "places 5"]
    s: Float[Array, "places"]
    chart: Int[Array, "places"]
    end: Float[Array, "5"]
    end_s: Float[Array, ""]
    branched: Bool[Array, ""]
    failed: Bool[Array, ""]


_PLANE, _END = 6, 7  # fifth equations: 0-3 slip of a contact, 4-5 speed of a joint, then these


def _coordinate(marched, chart, z):
    return marched.anchor_s[chart] + marched.charts[chart] @ (z - marched.anchors[chart])


def _fifth(system, heading, marched, z, hint, plane):
    """The equations that may fix a place on the wire beside the C-functions; the last is what ends the wire."""
    x = tangent(system, z, hint)
    pairs = system.candidates.lower.shape[0]
    made = jax.tree.map(lambda a: a[jnp.clip(marched.end, 0, pairs - 1)], system.candidates)
    held = frames(system.contacts, z)
    room = [held.along - system.contacts.lower, system.contacts.upper - held.along]
    ahead = heading.until_value - z[heading.until_coordinate]
    others = jnp.concatenate([*room, ahead[None]])
    ending = jnp.where(marched.end < pairs, frames(made, z).gap, others[jnp.maximum(marched.end - pairs, 0)])
    still = hint @ (z - plane)
    return jnp.concatenate([speeds_of(system, z, x), jnp.stack([still, jnp.where(marched.end < 0, still, ending)])])


def _places(system, heading, marched, resolution):
    """Sharpen the bracketed end and every sign change of slips and joint speeds to rounding level."""
    fixed = stop_gradient(system)
    last = jnp.maximum(marched.n - 1, 0)
    (found,) = jnp.nonzero(marched.flips.ravel(), size=resolution.pieces - 1, fill_value=-1)
    used = jnp.append(found >= 0, True)
    segment = jnp.append(jnp.where(found >= 0, found // 7, 0), last)
    what = jnp.append(jnp.where(found >= 0, found % 7, _PLANE), _END)
    fraction = marched.share[segment, jnp.minimum(what, _PLANE)][:, None]
    guess = marched.z[segment - 1] * (1 - fraction) + marched.z[segment] * fraction
    guess = jnp.where(used[:, None], guess, marched.z[0]).at[-1].set(marched.end_z)

    # A chart ends at the node before the first step in the next one.
    chart = marched.chart[jnp.maximum(segment - (what == _PLANE), 0)]

    def locate(segment, what, guess, chart):
        hint = marched.x[jnp.maximum(segment - 1, 0)]

        def equations(z, system, heading):
            fifth = _fifth(system, heading, marched, z, hint, guess)[what]
            return jnp.concatenate([constraints(system.contacts, z), fifth[None]])

        root = newton(equations, guess, system, heading)
        return root.z, root.residual, _coordinate(marched, chart, root.z)

    z, residual, s = jax.vmap(locate)(segment, what, guess, chart)
    slack = jnp.where(what == _END, 4 * SHORTEST, digits(z, 3 / 8))
    before = jnp.where(segment > 0, marched.s[jnp.maximum(segment - 1, 0)], 0.0)
    astray = (residual > digits(z, 1 / 2)) | (s < before - slack) | (s > marched.s[segment] + slack)
    failed = jnp.any(used & astray)
    kinks = jnp.where(used[:-1], s[:-1], jnp.inf)
    rank = jnp.argsort(stop_gradient(kinks))
    branched = _branches(fixed, marched, stop_gradient(z[-1]), astray[-1])
    return _Places(z[rank], kinks[rank], chart[rank], z[-1], s[-1], branched, failed)


def _branches(system, marched, end, astray):
    """Whether the wire meets another one on its way: `det [G; x]` changes sign."""
    rows, last = jnp.arange(marched.s.shape[0]), jnp.maximum(marched.n - 1, 0)
    # The last node lies a little beyond the end: it counts only if the end was not found.
    _, at_end = oriented_tangent(system, end, marched.x[jnp.maximum(last - 1, 0)])
    along = jnp.where((rows == last) & ~astray, at_end, marched.orientation)
    live = (rows < marched.n) & (rows > 0) & (marched.end >= 0)
    size = jnp.abs(jnp.where(live, along, along[0])).max()
    # Where two wires meet, Newton's method finds the end to half of the digits only.
    return jnp.any(live & (along * jnp.sign(along[0]) < digits(end, 3 / 8) * size))


# --- pieces, panels and nodes ----------------------------------------------------------------------------------------


def chebyshev(nodes: int) -> np.ndarray:
    """Chebyshev points of the first kind on [-1, 1], increasing."""
    return -np.cos(np.pi * (np.arange(nodes) + 0.5) / nodes)


def _cut(system, fixed, marched, places, start, resolution):
    """Lay panels over the pieces and solve the C-functions at every node."""
    inside = jnp.isfinite(places.s) & (stop_gradient(places.s) < stop_gradient(places.end_s))
    count = inside.sum() + 1
    last = marched.chart[jnp.maximum(marched.n - 1, 0)]
    # Piece k ends at place k, which lies in the chart of the segment before it.
    owner_chart = jnp.append(jnp.where(inside, places.chart, last), last)
    chart, anchor = marched.charts[owner_chart], marched.anchors[owner_chart]
    entry = jnp.concatenate([start[None], places.z])
    live = jnp.arange(resolution.pieces) < count

    # Two charts give the place where they meet the same `s`, also where that place moves with the scene.
    before = jnp.concatenate([owner_chart[:1], owner_chart[:-1]])
    coordinate = jax.vmap(_coordinate, (None, 0, 0))
    jump = jnp.where(live, coordinate(marched, before, entry) - coordinate(marched, owner_chart, entry), 0.0)
    shift = jnp.cumsum(jump)
    anchor_s = marched.anchor_s[owner_chart] + shift
    end_s = places.end_s + shift[-1]
    kinks = jnp.where(inside, jnp.where(inside, places.s, 0.0) + shift[:-1], end_s)
    breaks = jnp.concatenate([_coordinate(marched, 0, start)[None], kinks, end_s[None]])

    old = marched.charts[before]
    x_entry = jax.vmap(lambda z, u: tangent(system, z, u))(entry, old)
    factor = jnp.where(live, (chart * x_entry).sum(1) / (old * x_entry).sum(1), 1.0)

    first, panels, owner = _panels(stop_gradient(breaks), count, resolution)
    local = (jnp.arange(resolution.panels) - first[owner])[:, None] + (chebyshev(resolution.nodes) + 1) / 2
    low, high = breaks[owner][:, None], breaks[owner + 1][:, None]
    s = low + (high - low) * local / panels[owner][:, None]
    guess = _interpolate(marched, places, stop_gradient(s), chart[owner])

    def node(s, guess, u, anchor, anchor_s):
        height = u @ anchor + s - anchor_s
        z, moved, inverted, _ = correct(fixed, u, guess, stop_gradient(height), 2, digits(guess, 3 / 8))

        def equations(z, system, height):
            return jnp.concatenate([constraints(system.contacts, z), (u @ z - height)[None]])

        found = z - times(stop_gradient(inverted), equations(stop_gradient(z), system, height))
        return found, moved, speeds_of(fixed, stop_gradient(found), _refined(fixed, stop_gradient(found), u, inverted))

    per_panel = jax.vmap(node, (0, 0, None, None, None))
    nodes, moved, speeds = jax.vmap(per_panel)(s, guess, chart[owner], anchor[owner], anchor_s[owner])
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
        residual=jnp.zeros(()),
        start_gaps=jnp.zeros(4),
        count=count,
        breaks=breaks,
        chart=chart,
        anchor=anchor,
        anchor_s=anchor_s,
        factor=factor,
        slip_sign=slip_sign,
        joint_sign=joint_sign,
        first=first,
        panels=panels,
        owner=owner,
        nodes=nodes,
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
    # What rounding leaves over goes to the last piece that is used.
    panels = panels.at[count - 1].add(resolution.panels - panels.sum())
    first = jnp.concatenate([jnp.zeros(1, int), jnp.cumsum(panels)[:-1]])
    owner = jnp.searchsorted(jnp.cumsum(panels), jnp.arange(resolution.panels), side="right")
    return first, panels, owner


def _interpolate(marched, places, s, u):
    """Cubic Hermite guess of `z` at every `s` from the march's nodes."""
    right = jnp.clip(jnp.searchsorted(marched.s, s), 1, jnp.maximum(marched.n - 1, 1))
    left = right - 1
    width = marched.s[right] - marched.s[left]
    width = jnp.where(jnp.isfinite(width) & (width > 0), width, 1.0)[..., None]
    f = ((s - marched.s[left])[..., None]) / width
    slope = [marched.x[k] / jnp.einsum("pni,pi->pn", marched.x[k], u)[..., None] * width for k in (left, right)]
    low, high = marched.z[left], marched.z[right]
    return (
        low * (1 + 2 * f) * (1 - f) ** 2
        + high * f**2 * (3 - 2 * f)
        + slope[0] * f * (1 - f) ** 2
        + slope[1] * f**2 * (f - 1)
    )


def _signs(values, owner, resolution):
    """Signs of slips and joint speeds of each piece, and whether any node contradicts its piece's sign."""
    total = jax.ops.segment_sum(values.sum(1), owner, resolution.pieces)
    tolerance = digits(values, 5 / 8)
    signs = signs_of(total, tolerance)
    missed = jnp.any(values * signs[owner][:, None] < -tolerance) | ~jnp.all(jnp.isfinite(values))
    return signs[:, :4], signs[:, 4:], missed
