r"""Trace: the curve `z(s)` on which a formation of four constraints moves, its ends, kinks and nodes.

Four C-functions (gaps, and the places where rolling contacts touch) in five unknowns leave a wire that depends on
geometry alone. It is charted by the linear coordinate
`s = s_ref + u . (z - z_ref)` (object units, see `scaled_mechanics`), `u` being the unit tangent where the chart begins; a wire
that turns away from `u` continues in a new chart, so turning points of single coordinates are nothing special. The
search for its end and its kinks (`trace_curve`) runs on constants; at every place that it finds something vanishes on the
wire, from which derivatives follow (`solve_on_path`).

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

from wholearm_jax.core.arrays import as_device_array, eps_power
from wholearm_jax.core.small_linalg import fused_matmul
from wholearm_jax.core.status import Status
from wholearm_jax.model.contact_kinematics import constraint_jacobian, constraints, anchor_rolling
from wholearm_jax.model.mechanics import ScaledMechanics
from wholearm_jax.model.scene import PathTarget
from wholearm_jax.tracing.continuation import newton_corrector, trace_curve, sign_with_deadband, reversal_functions
from wholearm_jax.tracing.event_location import path_coordinate, locate_events
from wholearm_jax.tracing.projection import is_rank_deficient, dominant_coordinate, violates_contact_limits, orient_tangent, project_onto_path

NO_END, MADE, LEFT, UNTIL = range(4)  # why a wire ends


class Resolution(NamedTuple):
    """Sizes of a wire's table: at most `pieces` smooth pieces, `panels` panels in all, `nodes` Chebyshev nodes each.

    `trace_curve` is how many steps, 0.06 radians or object radii each, follow a wire to its end.
    """

    pieces: int = 6
    panels: int = 64
    nodes: int = 8
    march: int = 256


class PathSegments(eqx.Module):
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


class ContactPath(PathSegments):
    """A traced wire in object units: its pieces, their panels and nodes, and how it ends.

    `slip_sign` (Xi) and `joint_sign` hold
    for forward travel. Panels `first[k] ... first[k] + panels[k] - 1` belong to piece `k`; `nodes[p, i]` is `z` at node
    `i` of panel `p`. `end_why` says why the wire ends and `end_contact` which contact is made (a row of
    `ScaledMechanics.candidates`) or leaves its feature (a row of `ScaledMechanics.contact_set`).
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


def trace_path(system: ScaledMechanics, rough: Float[Array, "5"], heading: PathTarget, resolution: Resolution) -> ContactPath:
    """Project `rough` (SI) onto the formation and follow its wire as `path_target` says, to its end.

    Never raises for a configuration that does not work: `ContactPath.status` says `no_convergence` (the contacts cannot all
    touch near the start), `left_formation` (there a contact is beyond its feature, or the object inside a link),
    `singular` (fold or branch), `max_steps` (no end within reach) or `ok`.
    """
    rough = rough / system.configuration_unit
    until = heading.until_value / system.configuration_unit[heading.until_coordinate]
    heading = eqx.tree_at(lambda h: h.until_value, heading, until)
    system = eqx.tree_at(lambda s: s.contacts, system, anchor_rolling(system.contacts, rough))
    fixed, fixed_heading = stop_gradient(system), stop_gradient(heading)

    start, residual, along = project_onto_path(system, rough)
    first_tangent = orient_tangent(along, fixed_heading)
    marched = trace_curve(fixed, fixed_heading, stop_gradient(start), first_tangent, resolution.march)
    places = locate_events(system, heading, marched, resolution.pieces)
    wire = _solve_nodes(system, fixed, marched, places, start, resolution)
    touching = residual < 100 * jnp.finfo(rough.dtype).eps
    tied = ~touching & is_rank_deficient(fixed, stop_gradient(rough))
    direction = jnp.abs(first_tangent[dominant_coordinate(heading, first_tangent)]) > 1e-6
    worst = jnp.select(
        [
            tied,
            ~touching,
            violates_contact_limits(fixed, stop_gradient(start)),
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


def placeholder_path(resolution: Resolution, contacts: int = 4) -> ContactPath:
    """A wire of the right shapes that was not found: something to compile with."""
    pieces, panels, nodes, _ = resolution
    each = {name: np.zeros((pieces, 5)) for name in ("chart", "anchor")}
    each |= {name: np.zeros(pieces) for name in ("anchor_s", "factor")}
    each |= {name: np.zeros(5) for name in ("start", "end")}
    each |= {"slip_sign": np.zeros((pieces, contacts)), "joint_sign": np.zeros((pieces, 2))}
    each |= {"breaks": np.arange(pieces + 1.0), "nodes": np.zeros((panels, nodes, 5))}
    each |= {"first": np.zeros(pieces, int), "panels": np.ones(pieces, int), "owner": np.zeros(panels, int)}
    each |= {"count": 1, "status": int(Status.NO_CONVERGENCE), "end_why": NO_END, "end_contact": 0}
    return ContactPath(**{name: as_device_array(value) for name, value in each.items()})


def chebyshev_points(nodes: int) -> np.ndarray:
    """Chebyshev points of the first kind on [-1, 1], increasing."""
    return -np.cos(np.pi * (np.arange(nodes) + 0.5) / nodes)


def _segments(marched, places, start, resolution) -> PathSegments:
    """Cut the wire into its pieces, each in the chart that it is charted by."""
    # A kink at the end cuts off no piece: in one so short forces vary by rounding alone, and so would the place of the
    # least and the derivatives there.
    before_end = stop_gradient(places.s) < stop_gradient(places.end_s) - eps_power(places.end_s, 5 / 8)
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
    by_chart = jax.vmap(path_coordinate, (None, 0, 0))
    jump = jnp.where(live, by_chart(marched, before, entry) - by_chart(marched, owner_chart, entry), 0.0)
    shift = jnp.cumsum(jump)
    anchor_s = marched.charts.anchor_s[owner_chart] + shift
    end_s = places.end_s + shift[-1]
    kinks = jnp.where(inside, jnp.where(inside, places.s, 0.0) + shift[:-1], end_s)
    breaks = jnp.concatenate([path_coordinate(marched, 0, start)[None], kinks, end_s[None]])

    old = directions[before]
    before_entry = jnp.where(live[1:], (old[1:] * places.x).sum(1), 1.0)
    factor = jnp.append(1.0, jnp.where(live[1:], (chart[1:] * places.x).sum(1) / before_entry, 1.0))
    return PathSegments(count, breaks, chart, anchor, anchor_s, factor)


def _solve_nodes(system, fixed, marched, places, start, resolution):
    """Lay panels over the pieces and solve the C-functions at every node."""
    laid = _segments(marched, places, start, resolution)
    first, panels, owner = _distribute_panels(stop_gradient(laid.breaks), laid.count, resolution)
    local = (jnp.arange(resolution.panels) - first[owner])[:, None] + (chebyshev_points(resolution.nodes) + 1) / 2
    low, high = laid.breaks[owner][:, None], laid.breaks[owner + 1][:, None]
    s = low + (high - low) * local / panels[owner][:, None]
    guess = _hermite_interpolant(marched, stop_gradient(s), laid.chart[owner])

    def node(s, guess, u, anchor, anchor_s):
        height = u @ anchor + s - anchor_s
        z, moved, inverted, _ = newton_corrector(fixed, u, guess, stop_gradient(height), 2, eps_power(guess, 3 / 8))

        def equations(z, system, height):
            return jnp.concatenate([constraints(system.contacts, z), (u @ z - height)[None]])

        found = z - fused_matmul(stop_gradient(inverted), equations(stop_gradient(z), system, height))
        here = stop_gradient(found)
        return found, moved, reversal_functions(fixed, here, _refined(fixed, here, u, inverted))

    per_panel = jax.vmap(node, (0, 0, None, None, None))
    nodes, moved, speeds = jax.vmap(per_panel)(s, guess, laid.chart[owner], laid.anchor[owner], laid.anchor_s[owner])
    slip_sign, joint_sign, missed = _segment_signs(stop_gradient(speeds), owner, resolution)
    pairs = system.candidates.lower.shape[0]
    contact = jnp.where(marched.end < pairs, marched.end, (marched.end - pairs) % 4)
    why = jnp.select([marched.end < 0, marched.end < pairs, marched.end < pairs + 8], [NO_END, MADE, LEFT], UNTIL)
    return ContactPath(
        status=(missed | (moved.max() > eps_power(nodes, 3 / 8))).astype(int),
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
    rows = jnp.concatenate([constraint_jacobian(system.contacts, z), u[None]])
    return x + fused_matmul(inverted, jnp.zeros(5, z.dtype).at[4].set(1.0) - fused_matmul(rows, x))


def _distribute_panels(breaks, count, resolution):
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


def _hermite_interpolant(marched, s, u):
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


def _segment_signs(values, owner, resolution):
    """Signs of slips and joint speeds of each piece, and whether any node contradicts its piece's sign.

    What is smooth and zero throughout a piece is zero on the whole wire. Where only a piece is too short to tell, as
    between kinks that meet, what it adjoins holds: the piece before it, or behind it at the start.
    """
    tolerance, piece = eps_power(values, 5 / 8), jnp.arange(resolution.pieces)
    total = jnp.where((owner == piece[:, None])[..., None], values.sum(1), 0.0).sum(1)
    signs = sign_with_deadband(total, tolerance)
    away = piece[:, None] - piece
    away = jnp.where(away >= 0, away, resolution.pieces - away)
    told_by = jnp.argmin(jnp.where(signs != 0, away[..., None], 2 * resolution.pieces), axis=1)
    signs = jnp.take_along_axis(signs, told_by, axis=0)
    missed = jnp.any(values * signs[owner][:, None] < -tolerance) | ~jnp.all(jnp.isfinite(values))
    return signs[:, :4], signs[:, 4:], missed
