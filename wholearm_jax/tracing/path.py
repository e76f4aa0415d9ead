r"""Trace: the curve `z(s)` on which a formation of four constraints moves, its ends, kinks and nodes.

Four C-functions (gaps, and the places where rolling contacts touch) in five unknowns leave a wire that depends on
geometry alone. It is charted by the linear coordinate
`s = s_ref + u . (z - z_ref)` (object units, see `scaled_mechanics`), `u` being the unit tangent where the chart
begins; a wire
that turns away from `u` continues in a new chart, so turning points of single coordinates are nothing special. The
search for its end and its kinks (`trace_curve`) runs on constants; at every place that it finds something vanishes on
the
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

from wholearm_jax.core import Status, as_device_array, eps_power, fused_matmul
from wholearm_jax.model import PathTarget, ScaledMechanics, anchor_rolling, constraint_jacobian, constraints
from wholearm_jax.tracing.continuation import newton_corrector, reversal_functions, sign_with_deadband, trace_curve
from wholearm_jax.tracing.event_location import locate_events, path_coordinate
from wholearm_jax.tracing.projection import (
    dominant_coordinate,
    is_rank_deficient,
    orient_tangent,
    project_onto_path,
    violates_contact_limits,
)

NO_END, MADE, LEFT, UNTIL = range(4)  # why a wire ends


class Resolution(NamedTuple):
    """Sizes of a wire's table: at most `segments` smooth pieces, `panels` panels in all, `nodes` Chebyshev nodes each.

    `trace_curve` is how many steps, 0.06 radians or object radii each, follow a wire to its end.
    """

    segments: int = 6
    panels: int = 64
    nodes: int = 8
    max_continuation_steps: int = 256


class PathSegments(eqx.Module):
    """The smooth pieces of a wire, and the charts that they lie in. Those beyond `count` are empty and lie at its end.

    Piece `k` covers `[breaks[k], breaks[k + 1]]` in the chart `chart[k]` about (`anchor[k]`, `anchor_s[k]`), and
    `speed_ratio[k]` is the ratio of `ds/dt` after entering the piece to that before.
    """

    count: Int[Array, ""]
    breakpoints: Float[Array, "segments_1"]
    chart: Float[Array, "segments 5"]
    anchor: Float[Array, "segments 5"]
    anchor_s: Float[Array, "segments"]
    speed_ratio: Float[Array, "segments"]


class ContactPath(PathSegments):
    """A traced wire in object units: its pieces, their panels and nodes, and how it ends.

    `slip_sign` (Xi) and `joint_sign` hold
    for forward travel. Panels `first[k] ... first[k] + panels[k] - 1` belong to piece `k`; `nodes[p, i]` is `z` at node
    `i` of panel `p`. `end_reason` says why the wire ends and `end_contact` which contact is made (a row of
    `ScaledMechanics.candidates`) or leaves its feature (a row of `ScaledMechanics.contact_set`).
    """

    status: Int[Array, ""]
    start: Float[Array, "5"]
    end: Float[Array, "5"]
    end_reason: Int[Array, ""]
    end_contact: Int[Array, ""]
    slip_sign: Float[Array, "segments rows"]
    joint_sign: Float[Array, "segments 2"]
    first: Int[Array, "segments"]
    panels: Int[Array, "segments"]
    segment_of_panel: Int[Array, "panels"]
    nodes: Float[Array, "panels nodes 5"]

    @property
    def length(self) -> Float[Array, ""]:
        """The wire's extent in `s`."""
        return self.breakpoints[-1] - self.breakpoints[0]


def trace_path(
    mechanics: ScaledMechanics, initial_guess: Float[Array, "5"], target: PathTarget, resolution: Resolution
) -> ContactPath:
    """Project `initial_guess` (SI) onto the formation and follow its wire as `path_target` says, to its end.

    Never raises for a configuration that does not work: `ContactPath.status` says `no_convergence` (the contacts
    cannot all
    touch near the start), `left_formation` (there a contact is beyond its feature, or the object inside a link),
    `singular` (fold or branch), `max_steps` (no end within reach) or `ok`.
    """
    initial_guess = initial_guess / mechanics.configuration_unit
    until = target.until_value / mechanics.configuration_unit[target.until_coordinate]
    target = eqx.tree_at(lambda h: h.until_value, target, until)
    mechanics = eqx.tree_at(lambda s: s.contacts, mechanics, anchor_rolling(mechanics.contacts, initial_guess))
    fixed, fixed_heading = stop_gradient(mechanics), stop_gradient(target)

    start, residual, along = project_onto_path(mechanics, initial_guess)
    first_tangent = orient_tangent(along, fixed_heading)
    curve = trace_curve(fixed, fixed_heading, stop_gradient(start), first_tangent, resolution.max_continuation_steps)
    places = locate_events(mechanics, target, curve, resolution.segments)
    path = _solve_nodes(mechanics, fixed, curve, places, start, resolution)
    touching = residual < 100 * jnp.finfo(initial_guess.dtype).eps
    tied = ~touching & is_rank_deficient(fixed, stop_gradient(initial_guess))
    direction = jnp.abs(first_tangent[dominant_coordinate(target, first_tangent)]) > 1e-6
    worst = jnp.select(
        [
            tied,
            ~touching,
            violates_contact_limits(fixed, stop_gradient(start)),
            ~direction,
            curve.status > 0,
            places.has_bifurcation,
            places.failed | path.status.astype(bool),
        ],
        [
            int(Status.SINGULAR),
            int(Status.NO_CONVERGENCE),
            int(Status.LEFT_FORMATION),
            int(Status.SINGULAR),
            curve.status,
            int(Status.SINGULAR),
            int(Status.NO_CONVERGENCE),
        ],
        0,
    )
    return eqx.tree_at(lambda w: w.status, path, worst)


def placeholder_path(resolution: Resolution, contacts: int = 4) -> ContactPath:
    """A wire of the right shapes that was not found: something to compile with."""
    segments, panels, nodes, _ = resolution
    each = {name: np.zeros((segments, 5)) for name in ("chart", "anchor")}
    each |= {name: np.zeros(segments) for name in ("anchor_s", "speed_ratio")}
    each |= {name: np.zeros(5) for name in ("start", "end")}
    each |= {"slip_sign": np.zeros((segments, contacts)), "joint_sign": np.zeros((segments, 2))}
    each |= {"breakpoints": np.arange(segments + 1.0), "nodes": np.zeros((panels, nodes, 5))}
    each |= {
        "first": np.zeros(segments, int),
        "panels": np.ones(segments, int),
        "segment_of_panel": np.zeros(panels, int),
    }
    each |= {"count": 1, "status": int(Status.NO_CONVERGENCE), "end_reason": NO_END, "end_contact": 0}
    return ContactPath(**{name: as_device_array(value) for name, value in each.items()})


def chebyshev_points(nodes: int) -> np.ndarray:
    """Chebyshev points of the first kind on [-1, 1], increasing."""
    return -np.cos(np.pi * (np.arange(nodes) + 0.5) / nodes)


def _segments(curve, places, start, resolution) -> PathSegments:
    """Cut the wire into its pieces, each in the chart that it is charted by."""
    # A kink at the end cuts off no piece: in one so short forces vary by rounding alone, and so would the place of the
    # least and the derivatives there.
    before_end = stop_gradient(places.s) < stop_gradient(places.end_s) - eps_power(places.end_s, 5 / 8)
    inside = jnp.isfinite(places.s) & before_end
    count = inside.sum() + 1
    last = curve.nodes.chart[jnp.maximum(curve.n - 1, 0)]
    # Piece k ends at place k, which lies in the chart of the segment before it.
    owner_chart = jnp.append(jnp.where(inside, places.chart, last), last)
    directions = curve.charts.direction
    chart, anchor = directions[owner_chart], curve.charts.anchor[owner_chart]
    entry = jnp.concatenate([start[None], places.z])
    live = jnp.arange(resolution.segments) < count

    # Two charts give the place where they meet the same `s`, also where that place moves with the scene.
    before = jnp.concatenate([owner_chart[:1], owner_chart[:-1]])
    by_chart = jax.vmap(path_coordinate, (None, 0, 0))
    jump = jnp.where(live, by_chart(curve, before, entry) - by_chart(curve, owner_chart, entry), 0.0)
    shift = jnp.cumsum(jump)
    anchor_s = curve.charts.anchor_s[owner_chart] + shift
    end_s = places.end_s + shift[-1]
    kinks = jnp.where(inside, jnp.where(inside, places.s, 0.0) + shift[:-1], end_s)
    breakpoints = jnp.concatenate([path_coordinate(curve, 0, start)[None], kinks, end_s[None]])

    old = directions[before]
    before_entry = jnp.where(live[1:], (old[1:] * places.x).sum(1), 1.0)
    speed_ratio = jnp.append(1.0, jnp.where(live[1:], (chart[1:] * places.x).sum(1) / before_entry, 1.0))
    return PathSegments(count, breakpoints, chart, anchor, anchor_s, speed_ratio)


def _solve_nodes(mechanics, fixed, curve, places, start, resolution):
    """Lay panels over the pieces and solve the C-functions at every node."""
    laid = _segments(curve, places, start, resolution)
    first, panels, segment_of_panel = _distribute_panels(stop_gradient(laid.breakpoints), laid.count, resolution)
    local = (jnp.arange(resolution.panels) - first[segment_of_panel])[:, None] + (
        chebyshev_points(resolution.nodes) + 1
    ) / 2
    low, high = laid.breakpoints[segment_of_panel][:, None], laid.breakpoints[segment_of_panel + 1][:, None]
    s = low + (high - low) * local / panels[segment_of_panel][:, None]
    guess = _hermite_interpolant(curve, stop_gradient(s), laid.chart[segment_of_panel])

    def node(s, guess, u, anchor, anchor_s):
        height = u @ anchor + s - anchor_s
        z, moved, inverted, _ = newton_corrector(fixed, u, guess, stop_gradient(height), 2, eps_power(guess, 3 / 8))

        def equations(z, mechanics, height):
            return jnp.concatenate([constraints(mechanics.contacts, z), (u @ z - height)[None]])

        found = z - fused_matmul(stop_gradient(inverted), equations(stop_gradient(z), mechanics, height))
        here = stop_gradient(found)
        return found, moved, reversal_functions(fixed, here, _refined(fixed, here, u, inverted))

    per_panel = jax.vmap(node, (0, 0, None, None, None))
    nodes, moved, speeds = jax.vmap(per_panel)(
        s, guess, laid.chart[segment_of_panel], laid.anchor[segment_of_panel], laid.anchor_s[segment_of_panel]
    )
    slip_sign, joint_sign, missed = _segment_signs(stop_gradient(speeds), segment_of_panel, resolution)
    pairs = mechanics.candidates.lower.shape[0]
    contact = jnp.where(curve.end < pairs, curve.end, (curve.end - pairs) % 4)
    why = jnp.select([curve.end < 0, curve.end < pairs, curve.end < pairs + 8], [NO_END, MADE, LEFT], UNTIL)
    return ContactPath(
        status=(missed | (moved.max() > eps_power(nodes, 3 / 8))).astype(int),
        start=start,
        end=places.end,
        end_reason=why,
        end_contact=contact,
        slip_sign=slip_sign,
        joint_sign=joint_sign,
        first=first,
        panels=panels,
        segment_of_panel=segment_of_panel,
        nodes=nodes,
        **vars(laid),
    )


def _refined(mechanics, z, u, inverted):
    """`dz/ds` in the chart `u`: the last column of `[G; u]^-1`, with an inverse from nearby mended by one step."""
    x = inverted[:, 4]
    rows = jnp.concatenate([constraint_jacobian(mechanics.contacts, z), u[None]])
    return x + fused_matmul(inverted, jnp.zeros(5, z.dtype).at[4].set(1.0) - fused_matmul(rows, x))


def _distribute_panels(breakpoints, count, resolution):
    """Share the panels among the pieces by length, at least one each."""
    lengths = jnp.diff(breakpoints)
    live = jnp.arange(resolution.segments) < count
    spare = resolution.panels - count
    share = jnp.floor(spare * jnp.where(live, lengths, 0.0) / jnp.maximum(lengths.sum(), 1e-30)).astype(int)
    panels = jnp.where(live, 1 + share, 0)
    longest = jnp.arange(resolution.segments) == jnp.argmax(lengths)
    panels = panels + jnp.where(longest, resolution.panels - panels.sum(), 0)  # what rounding leaves over
    first = jnp.concatenate([jnp.zeros(1, int), jnp.cumsum(panels)[:-1]])
    segment_of_panel = (jnp.arange(resolution.panels)[:, None] >= jnp.cumsum(panels)).sum(1)
    return first, panels, segment_of_panel


def _hermite_interpolant(curve, s, u):
    """Cubic Hermite guess of `z` at every `s` from the march's nodes."""
    nodes = curve.nodes
    right = jnp.clip((nodes.s < s[..., None]).sum(-1), 1, jnp.maximum(curve.n - 1, 1))
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


def _segment_signs(values, segment_of_panel, resolution):
    """Signs of slips and joint speeds of each piece, and whether any node contradicts its piece's sign.

    What is smooth and zero throughout a piece is zero on the whole wire. Where only a piece is too short to tell, as
    between kinks that meet, what it adjoins holds: the piece before it, or behind it at the start.
    """
    tolerance, segment = eps_power(values, 5 / 8), jnp.arange(resolution.segments)
    total = jnp.where((segment_of_panel == segment[:, None])[..., None], values.sum(1), 0.0).sum(1)
    signs = sign_with_deadband(total, tolerance)
    away = segment[:, None] - segment
    away = jnp.where(away >= 0, away, resolution.segments - away)
    told_by = jnp.argmin(jnp.where(signs != 0, away[..., None], 2 * resolution.segments), axis=1)
    signs = jnp.take_along_axis(signs, told_by, axis=0)
    missed = jnp.any(values * signs[segment_of_panel][:, None] < -tolerance) | ~jnp.all(jnp.isfinite(values))
    return signs[:, :4], signs[:, 4:], missed
