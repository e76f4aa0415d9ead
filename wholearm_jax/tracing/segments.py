"""Smooth segments of a path: their charts, signs and panels.

Derivation: section 3 of `docs/derivation.md`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float, Int

from wholearm_jax.core import eps_power
from wholearm_jax.tracing.curve import TracedCurve, path_coordinate, sign_with_deadband
from wholearm_jax.tracing.event_location import EventPoints
from wholearm_jax.tracing.path import PathSegments, Resolution


class PanelLayout(NamedTuple):
    """How panels are distributed over segments."""

    first: Int[Array, "segments"]  # first panel of each segment
    panels: Int[Array, "segments"]  # number of panels of each segment
    segment_of_panel: Int[Array, "panels"]


def split_into_segments(
    curve: TracedCurve, points: EventPoints, start: Float[Array, "5"], max_segments: int
) -> PathSegments:
    """Split a path at its kinks into smooth segments, each in its own chart."""
    # Ignore kinks within rounding of the end: a segment that short would make the margin's location and gradient pure
    # rounding noise.
    before_end = stop_gradient(points.s) < stop_gradient(points.end_s) - eps_power(points.end_s, 5 / 8)
    inside = jnp.isfinite(points.s) & before_end
    count = inside.sum() + 1
    live = jnp.arange(max_segments) < count
    last = curve.nodes.chart[jnp.maximum(curve.n - 1, 0)]
    # Segment k ends at point k, which lies in the chart of the segment before it.
    numbers = jnp.append(jnp.where(inside, points.chart, last), last)
    before = jnp.concatenate([numbers[:1], numbers[:-1]])
    chart, previous_chart = curve.charts.direction[numbers], curve.charts.direction[before]

    # Shift each chart's s so that two charts agree where they meet, also where that place moves with the scene.
    entry = jnp.concatenate([start[None], points.z])
    by_chart = jax.vmap(path_coordinate, (None, 0, 0))
    jump = jnp.where(live, by_chart(curve, before, entry) - by_chart(curve, numbers, entry), 0.0)
    shift = jnp.cumsum(jump)
    end_s = points.end_s + shift[-1]
    kinks = jnp.where(inside, jnp.where(inside, points.s, 0.0) + shift[:-1], end_s)

    # The speed ds/dt = u . z_dot changes with the chart.
    speed_before = jnp.where(live[1:], (previous_chart[1:] * points.x).sum(1), 1.0)
    speed_ratio = jnp.append(1.0, jnp.where(live[1:], (chart[1:] * points.x).sum(1) / speed_before, 1.0))
    return PathSegments(
        count=count,
        breakpoints=jnp.concatenate([path_coordinate(curve, 0, start)[None], kinks, end_s[None]]),
        chart=chart,
        anchor=curve.charts.anchor[numbers],
        anchor_s=curve.charts.anchor_s[numbers] + shift,
        speed_ratio=speed_ratio,
    )


def distribute_panels(
    breakpoints: Float[Array, "segments_1"], count: int | Int[Array, ""], resolution: Resolution
) -> PanelLayout:
    """Distribute the panels over the segments by length, at least one each; the longest takes the remainder."""
    lengths = jnp.diff(breakpoints)
    segment = jnp.arange(resolution.segments)
    spare = resolution.panels - count
    live = segment < count
    extra = jnp.floor(spare * jnp.where(live, lengths, 0.0) / jnp.maximum(lengths.sum(), 1e-30)).astype(int)
    panels = jnp.where(live, 1 + extra, 0)
    panels = panels + jnp.where(segment == jnp.argmax(lengths), resolution.panels - panels.sum(), 0)
    first = jnp.concatenate([jnp.zeros(1, int), jnp.cumsum(panels)[:-1]])
    return PanelLayout(first, panels, (jnp.arange(resolution.panels)[:, None] >= jnp.cumsum(panels)).sum(1))


def segment_signs(
    reversals: Float[Array, "panels nodes 6"], segment_of_panel: Int[Array, "panels"], segments: int
) -> tuple[Float[Array, "segments rows"], Float[Array, "segments 2"], Bool[Array, ""]]:
    """Determine the signs of slips and joint speeds in each segment, and whether any node contradicts them.

    A function that is zero throughout a smooth segment is zero on the whole path. Where a single segment is too short
    to show a sign, as between kinks that coincide, it takes that of the segment before it, or behind it at the start.
    """
    tolerance, segment = eps_power(reversals, 5 / 8), jnp.arange(segments)
    total = jnp.where((segment_of_panel == segment[:, None])[..., None], reversals.sum(1), 0.0).sum(1)
    signs = sign_with_deadband(total, tolerance)
    distance = segment[:, None] - segment
    distance = jnp.where(distance >= 0, distance, segments - distance)
    source = jnp.argmin(jnp.where(signs != 0, distance[..., None], 2 * segments), axis=1)
    signs = jnp.take_along_axis(signs, source, axis=0)
    contradicted = jnp.any(reversals * signs[segment_of_panel][:, None] < -tolerance)
    return signs[:, :4], signs[:, 4:], contradicted | ~jnp.all(jnp.isfinite(reversals))
