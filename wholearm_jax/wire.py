r"""Trace: the curve `z(s)` on which a formation of four constraints moves, its ends, kinks and nodes.

Four C-functions (gaps, and the places where rolling contacts touch) in five unknowns leave a wire that depends on
geometry alone. It is charted by the linear coordinate
`s = s_ref + u . (z - z_ref)` (object units, see `system`), `u` being the unit tangent where the chart begins; a wire
that turns away from `u` continues in a new chart, so turning points of single coordinates are nothing special. The
search below (march, watch, bracket) runs on constants; every place that it finds is then the root of five equations
in five unknowns, from which derivatives follow (`newton`).

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

from wholearm_jax.contacts import constraint_rows, constraints, frames, placed, slips
from wholearm_jax.elimination import inverse, solve, times
from wholearm_jax.newton import newton
from wholearm_jax.scene import Heading
from wholearm_jax.status import Status
from wholearm_jax.system import System

MAX_MARCH = 256  # nodes of the march: wires of up to about 12 radians or object radii
LONGEST, SHORTEST = 0.06, 2e-3  # march steps, and the step at which an end counts as bracketed
NO_END, MADE, LEFT, UNTIL = range(4)  # why a wire ends


class Resolution(NamedTuple):
    """Sizes of a wire's table: at most `pieces` smooth pieces, `panels` panels in all, `nodes` Chebyshev nodes each."""

    pieces: int = 6
    panels: int = 64
    nodes: int = 8


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
    march = _march(fixed, fixed_heading, stop_gradient(start), first_tangent)
    places = _places(system, heading, march, resolution)
    wire = _cut(system, fixed, march, places, start, resolution)
    touching = residual < 100 * jnp.finfo(rough.dtype).eps
    dependent = ~touching & _dependent(fixed, stop_gradient(rough))
    direction = jnp.abs(first_tangent[_leading(heading, first_tangent)]) > 1e-6
    worst = jnp.select(
        [
            dependent,
            ~touching,
            _misplaced(fixed, stop_gradient(start)),
            ~direction,
            march.status > 0,
            places.branched,
            places.failed | wire.status.astype(bool),
        ],
        [
            int(Status.SINGULAR),
            int(Status.NO_CONVERGENCE),
            int(Status.LEFT_FORMATION),
            int(Status.SINGULAR),
            march.status,
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


def _share(values, digits: float):
    """What is zero to a share of the digits of a precision: 1e-10 for five eighths of float64, 5e-5 of float32."""
    return jnp.finfo(values.dtype).eps ** digits


# --- the wire's start and tangent -----------------------------------------------------------------------------------


def tangent(system: System, z: Float[Array, "5"], hint: Float[Array, "5"]) -> Float[Array, "5"]:
    """Unit null vector of `G` with a positive component along `hint`."""
    return _oriented_tangent(system, z, hint)[0]


def _oriented_tangent(system, z, hint):
    """The unit tangent `x` and `det [G; x]`: the product of singular values, which changes sign where wires meet."""
    inverted, determinant = inverse(jnp.concatenate([constraint_rows(system.contacts, z), hint[None]]))
    size = jnp.sqrt((inverted[:, 4] ** 2).sum())
    return inverted[:, 4] / size, determinant * size  # hint = x / size + what the rows of G span


def _speeds(system, z, x):
    """What reverses at kinks: the slips of the contacts and the joints' speeds."""
    return jnp.concatenate([slips(system.contacts, z, x), x[3:]])


def _watch(system, heading, z):
    """Values that must stay positive along the wire, and how far along its feature each candidate contact lies."""
    pairs, held = frames(system.candidates, z), frames(system.contacts, z)
    sense = jnp.where(heading.until_coordinate < 0, 0.0, 1.0)
    ahead = (heading.until_value - z[heading.until_coordinate]) * sense + (1 - sense)
    room = [held.along - system.contacts.lower, system.contacts.upper - held.along]
    return jnp.concatenate([pairs.gap, *room, ahead[None]]), pairs.along


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
    near = jnp.where(root.residual < _share(z, 3 / 8), root.z, z)
    return near, jnp.abs(constraints(fixed.contacts, stop_gradient(near))).max()


def _misplaced(system, z):
    """Whether a contact lies beyond its feature, or a vertex behind the palm or (of a convex object) a finger."""
    tolerance = _share(z, 5 / 8)
    held, pairs = frames(system.contacts, z), frames(system.candidates, z)
    beyond = (held.along < system.contacts.lower - tolerance) | (held.along > system.contacts.upper + tolerance)
    inside = (pairs.along > system.candidates.lower) & (pairs.along < system.candidates.upper)
    palm = system.candidates.finger.sum(1) == 0
    behind = system.watched & system.candidates.on_link & inside & (pairs.gap < -tolerance)
    return jnp.any(beyond) | jnp.any(behind & (palm | system.convex))


def _dependent(system, z):
    """Whether the constraints depend on one another at `z`: their rows span no volume."""
    rows = constraint_rows(system.contacts, z)
    rows = rows / jnp.sqrt((rows**2).sum(1, keepdims=True))
    return inverse(times(rows, rows.T))[1] < _share(z, 3 / 4)


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


# --- the march -------------------------------------------------------------------------------------------------------


class _Watched(NamedTuple):
    """Values that stay positive on a wire (`_watch`), their rates `d/ds`, and places along candidate features."""

    values: Float[Array, "watch"]
    rates: Float[Array, "watch"]
    along: Float[Array, "candidates"]


class _March(NamedTuple):
    """Nodes along the wire: `n` of them, in charts numbered by `chart`; the last is where the end was bracketed.

    `orientation` is `det [G; x]` at each; `flips` says what reverses or turns on the way to it from the node before
    (`_speeds`, then the chart), at what `share` of that way. `speeds` are those of the last node, `sense` the signs
    that they had last. `before` is what is watched at the last node within the wire, `beyond` at the last one tried.
    """

    n: Int[Array, ""]
    step: Float[Array, ""]
    z: Float[Array, "march 5"]
    x: Float[Array, "march 5"]
    s: Float[Array, "march"]
    speeds: Float[Array, "6"]
    sense: Float[Array, "6"]
    flips: Bool[Array, "march 7"]
    share: Float[Array, "march 7"]
    orientation: Float[Array, "march"]
    chart: Int[Array, "march"]
    charts: Float[Array, "charts 5"]
    anchors: Float[Array, "charts 5"]
    anchor_s: Float[Array, "charts"]
    number: Int[Array, ""]
    before: _Watched
    beyond: _Watched
    end: Int[Array, ""]
    end_z: Float[Array, "5"]
    status: Int[Array, ""]
    done: Float[Array, ""]


_CHARTS = 8


def _march(system, heading, z, x):
    """Follow the wire in short steps until something ends it; remember the nodes."""
    sense = jnp.where(heading.until_value < z[heading.until_coordinate], -1.0, 1.0)
    tolerance = _share(z, 5 / 8)

    def watch(z, x, u):
        def signed(z):
            values, along = _watch(system, heading, z)
            return values.at[-1].multiply(jnp.where(heading.until_coordinate < 0, 1.0, sense)), along

        (values, along), (rates, _) = jax.jvp(signed, (z,), (x / (u @ x),))
        return _Watched(values, rates, along)

    def buffer(row):
        return jnp.zeros((MAX_MARCH, *row.shape), row.dtype).at[0].set(row)

    watched = watch(z, x, x)
    speeds = _speeds(system, z, x)
    begin = _March(
        n=jnp.asarray(1),
        step=jnp.asarray(LONGEST, z.dtype),
        z=buffer(z),
        x=buffer(x),
        s=jnp.full(MAX_MARCH, jnp.inf, z.dtype).at[0].set(0.0),
        speeds=speeds,
        sense=_signs_of(speeds, tolerance),
        flips=buffer(jnp.zeros(7, bool)),
        share=buffer(jnp.zeros(7, z.dtype)),
        orientation=buffer(_oriented_tangent(system, z, x)[1]),
        chart=jnp.zeros(MAX_MARCH, int),
        charts=jnp.zeros((_CHARTS, 5), z.dtype).at[0].set(x),
        anchors=jnp.zeros((_CHARTS, 5), z.dtype).at[0].set(z),
        anchor_s=jnp.zeros(_CHARTS, z.dtype),
        number=jnp.asarray(0),
        before=watched,
        beyond=watched,
        end=jnp.asarray(-1),
        end_z=z,
        status=jnp.asarray(0),
        done=jnp.asarray(False),
    )

    def step(m: _March) -> _March:
        z, x, u = m.z[m.n - 1], m.x[m.n - 1], m.charts[m.number]
        z_new, moved, _ = _correct(system, u, z + m.step * x / (u @ x), u @ z + m.step)
        x_new, orientation = _oriented_tangent(system, z_new, u)
        watched = watch(z_new, x_new, u)
        good = (moved < _share(z, 1 / 2)) & (x_new @ x > 0.98) & jnp.all(jnp.isfinite(x_new))
        crossed, _ = _crossings(system, m.before, watched, m.step, tolerance)
        ends = good & jnp.any(crossed)
        bracketed = ends & (m.step <= SHORTEST)
        accept = good & ~jnp.any(crossed)
        row = jnp.where(accept | bracketed, m.n, MAX_MARCH)
        turn = accept & (u @ x_new < 0.6)
        number = m.number + turn
        chart_row = jnp.where(turn, number, _CHARTS)
        s_new = m.s[m.n - 1] + m.step
        speeds = _speeds(system, z_new, x_new)
        sign = _signs_of(speeds, tolerance)
        flips = sign * m.sense < 0
        share = jnp.where(flips, jnp.clip(m.speeds / jnp.where(flips, m.speeds - speeds, 1.0), 0.0, 1.0), 0.0)
        shorter = jnp.where(ends, jnp.maximum(m.step / 4, SHORTEST), m.step / 2)
        lost = ~good & (m.step < 1e-6)
        full = (m.n + 1 >= MAX_MARCH) | (number >= _CHARTS)
        return m._replace(
            n=m.n + (accept | bracketed),
            step=jnp.where(accept, jnp.minimum(m.step * 1.5, LONGEST), shorter),
            z=m.z.at[row].set(z_new, mode="drop"),
            x=m.x.at[row].set(x_new, mode="drop"),
            s=m.s.at[row].set(s_new, mode="drop"),
            speeds=jnp.where(accept, speeds, m.speeds),
            sense=jnp.where(accept & (sign != 0), sign, m.sense),
            flips=m.flips.at[row].set(jnp.append(flips, m.number != m.chart[m.n - 1]), mode="drop"),
            share=m.share.at[row].set(jnp.append(share, 0.0), mode="drop"),
            orientation=m.orientation.at[row].set(orientation, mode="drop"),
            chart=m.chart.at[row].set(m.number, mode="drop"),
            charts=m.charts.at[chart_row].set(x_new, mode="drop"),
            anchors=m.anchors.at[chart_row].set(z_new, mode="drop"),
            anchor_s=m.anchor_s.at[chart_row].set(s_new, mode="drop"),
            number=number,
            before=jax.tree.map(
                lambda new, old: jnp.where(accept, new, old),
                watched._replace(rates=watched.rates * jnp.where(turn, u @ x_new, 1.0)),
                m.before,
            ),
            beyond=watched,
            status=jnp.select([lost, full & ~bracketed], [int(Status.SINGULAR), int(Status.MAX_STEPS)], 0),
            done=bracketed | lost | full,
        )

    return _ended(system, jax.lax.while_loop(lambda m: ~m.done, step, begin), tolerance)


def _ended(system, m: _March, tolerance) -> _March:
    """What ends the wire first between the last two nodes of a march, and about where."""
    low, high = jnp.maximum(m.n - 2, 0), jnp.maximum(m.n - 1, 1)
    step = jnp.where(m.status == 0, m.s[high] - m.s[low], 1.0)
    crossed, where = _crossings(system, m.before, m.beyond, step, tolerance)
    first = jnp.argmin(jnp.where(crossed, where, jnp.inf))
    z = m.z[low] + (m.z[high] - m.z[low]) * where[first]
    found = (m.status == 0) & jnp.any(crossed)
    return m._replace(end=jnp.where(found, first, -1), end_z=jnp.where(found, z, m.end_z))


def _correct(system, u, z, height, steps=3):
    """Newton in the chart: the point of the wire on the plane `u . z = height`, the last step's size and inverse."""

    def once(_, state):
        z, *_ = state
        inverted, _ = inverse(jnp.concatenate([constraint_rows(system.contacts, z), u[None]]))
        left = jnp.concatenate([constraints(system.contacts, z), (u @ z - height)[None]])
        move = times(inverted, left)
        return z - move, jnp.abs(move).max(), inverted

    start = (z, jnp.asarray(jnp.inf, z.dtype), jnp.eye(5, dtype=z.dtype))
    z, moved, inverted = jax.lax.fori_loop(0, steps, once, start)
    return z, jnp.where(jnp.isfinite(moved), moved, jnp.inf), inverted


def _crossings(system, before: _Watched, after: _Watched, step, tolerance):
    """Which watched values turn negative within a step (or dip below zero and return), and at what share of it.

    The share is a root of the cubic through values and rates: several things that end a wire within the shortest step
    are told apart to 1e-13.
    """
    old, new = before.values, after.values
    through = (old >= -tolerance) & (new < -tolerance)
    slope = jnp.where(after.rates > before.rates, after.rates - before.rates, 1.0)
    turns = (before.rates < 0) & (after.rates > 0) & (old > tolerance) & (new > tolerance)
    dips = turns & (old - step * before.rates**2 / (2 * slope) < 0)
    line = jnp.clip(old / jnp.where(through, old - new, 1.0), 0.0, 1.0)
    bend = jnp.sqrt(jnp.where(dips, before.rates**2 - 2 * old * slope / step, 0.0))
    where = jnp.where(through, line, (-before.rates - bend) / slope)
    low, high = step * before.rates, step * after.rates
    square, cube = 3 * (new - old) - 2 * low - high, low + high - 2 * (new - old)
    for _ in range(2):
        rate = low + where * (2 * square + 3 * where * cube)
        better = where - (old + where * (low + where * (square + where * cube))) / jnp.where(rate < 0, rate, -1.0)
        where = jnp.where((rate < 0) & (better >= 0) & (better <= 1), better, where)
    pairs = system.candidates.lower.shape[0]
    at = before.along + (after.along - before.along) * where[:pairs]
    inside = (at >= system.candidates.lower - tolerance) & (at <= system.candidates.upper + tolerance)
    counts = jnp.concatenate([inside & system.watched, jnp.ones(new.shape[0] - pairs, bool)])
    return (through | dips) & counts, where


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


def _coordinate(march, chart, z):
    return march.anchor_s[chart] + march.charts[chart] @ (z - march.anchors[chart])


def _fifth(system, heading, march, z, hint, plane):
    """The equations that may fix a place on the wire beside the C-functions; the last is what ends the wire."""
    x = tangent(system, z, hint)
    pairs = system.candidates.lower.shape[0]
    made = jax.tree.map(lambda a: a[jnp.clip(march.end, 0, pairs - 1)], system.candidates)
    held = frames(system.contacts, z)
    room = [held.along - system.contacts.lower, system.contacts.upper - held.along]
    ahead = heading.until_value - z[heading.until_coordinate]
    others = jnp.concatenate([*room, ahead[None]])
    ending = jnp.where(march.end < pairs, frames(made, z).gap, others[jnp.maximum(march.end - pairs, 0)])
    still = hint @ (z - plane)
    return jnp.concatenate([_speeds(system, z, x), jnp.stack([still, jnp.where(march.end < 0, still, ending)])])


def _places(system, heading, march, resolution):
    """Sharpen the bracketed end and every sign change of slips and joint speeds to rounding level."""
    fixed = stop_gradient(system)
    last = jnp.maximum(march.n - 1, 0)
    (found,) = jnp.nonzero(march.flips.ravel(), size=resolution.pieces - 1, fill_value=-1)
    used = jnp.append(found >= 0, True)
    segment = jnp.append(jnp.where(found >= 0, found // 7, 0), last)
    what = jnp.append(jnp.where(found >= 0, found % 7, _PLANE), _END)
    fraction = march.share[segment, jnp.minimum(what, _PLANE)][:, None]
    guess = march.z[segment - 1] * (1 - fraction) + march.z[segment] * fraction
    guess = jnp.where(used[:, None], guess, march.z[0]).at[-1].set(march.end_z)

    # A chart ends at the node before the first step in the next one.
    chart = march.chart[jnp.maximum(segment - (what == _PLANE), 0)]

    def locate(segment, what, guess, chart):
        hint = march.x[jnp.maximum(segment - 1, 0)]

        def equations(z, system, heading):
            fifth = _fifth(system, heading, march, z, hint, guess)[what]
            return jnp.concatenate([constraints(system.contacts, z), fifth[None]])

        root = newton(equations, guess, system, heading)
        return root.z, root.residual, _coordinate(march, chart, root.z)

    z, residual, s = jax.vmap(locate)(segment, what, guess, chart)
    slack = jnp.where(what == _END, 4 * SHORTEST, _share(z, 3 / 8))
    before = jnp.where(segment > 0, march.s[jnp.maximum(segment - 1, 0)], 0.0)
    astray = (residual > _share(z, 1 / 2)) | (s < before - slack) | (s > march.s[segment] + slack)
    failed = jnp.any(used & astray)
    kinks = jnp.where(used[:-1], s[:-1], jnp.inf)
    rank = jnp.argsort(stop_gradient(kinks))
    branched = _branches(fixed, march, stop_gradient(z[-1]), astray[-1])
    return _Places(z[rank], kinks[rank], chart[rank], z[-1], s[-1], branched, failed)


def _branches(system, march, end, astray):
    """Whether the wire meets another one on its way: `det [G; x]` changes sign."""
    rows, last = jnp.arange(MAX_MARCH), jnp.maximum(march.n - 1, 0)
    # The last node lies a little beyond the end: it counts only if the end was not found.
    _, at_end = _oriented_tangent(system, end, march.x[jnp.maximum(last - 1, 0)])
    along = jnp.where((rows == last) & ~astray, at_end, march.orientation)
    live = (rows < march.n) & (rows > 0) & (march.end >= 0)
    size = jnp.abs(jnp.where(live, along, along[0])).max()
    # Where two wires meet, Newton's method finds the end to half of the digits only.
    return jnp.any(live & (along * jnp.sign(along[0]) < _share(end, 3 / 8) * size))


def _signs_of(values, tolerance):
    """Signs, 0 for what is no larger than `tolerance`."""
    return jnp.where(jnp.abs(values) > tolerance, jnp.sign(values), 0.0)


# --- pieces, panels and nodes ----------------------------------------------------------------------------------------


def chebyshev(nodes: int) -> np.ndarray:
    """Chebyshev points of the first kind on [-1, 1], increasing."""
    return -np.cos(np.pi * (np.arange(nodes) + 0.5) / nodes)


def _cut(system, fixed, march, places, start, resolution):
    """Lay panels over the pieces and solve the C-functions at every node."""
    inside = jnp.isfinite(places.s) & (stop_gradient(places.s) < stop_gradient(places.end_s))
    count = inside.sum() + 1
    last = march.chart[jnp.maximum(march.n - 1, 0)]
    # Piece k ends at place k, which lies in the chart of the segment before it.
    owner_chart = jnp.append(jnp.where(inside, places.chart, last), last)
    chart, anchor = march.charts[owner_chart], march.anchors[owner_chart]
    entry = jnp.concatenate([start[None], places.z])
    live = jnp.arange(resolution.pieces) < count

    # Two charts give the place where they meet the same `s`, also where that place moves with the scene.
    before = jnp.concatenate([owner_chart[:1], owner_chart[:-1]])
    coordinate = jax.vmap(_coordinate, (None, 0, 0))
    jump = jnp.where(live, coordinate(march, before, entry) - coordinate(march, owner_chart, entry), 0.0)
    shift = jnp.cumsum(jump)
    anchor_s = march.anchor_s[owner_chart] + shift
    end_s = places.end_s + shift[-1]
    kinks = jnp.where(inside, jnp.where(inside, places.s, 0.0) + shift[:-1], end_s)
    breaks = jnp.concatenate([_coordinate(march, 0, start)[None], kinks, end_s[None]])

    old = march.charts[before]
    x_entry = jax.vmap(lambda z, u: tangent(system, z, u))(entry, old)
    factor = jnp.where(live, (chart * x_entry).sum(1) / (old * x_entry).sum(1), 1.0)

    first, panels, owner = _panels(stop_gradient(breaks), count, resolution)
    local = (jnp.arange(resolution.panels) - first[owner])[:, None] + (chebyshev(resolution.nodes) + 1) / 2
    low, high = breaks[owner][:, None], breaks[owner + 1][:, None]
    s = low + (high - low) * local / panels[owner][:, None]
    guess = _interpolate(march, places, stop_gradient(s), chart[owner])

    def node(s, guess, u, anchor, anchor_s):
        height = u @ anchor + s - anchor_s
        z, moved, inverted = _correct(fixed, u, guess, stop_gradient(height), steps=2)  # the guess has seven digits

        def equations(z, system, height):
            return jnp.concatenate([constraints(system.contacts, z), (u @ z - height)[None]])

        found = z - times(stop_gradient(inverted), equations(stop_gradient(z), system, height))
        return found, moved, _speeds(fixed, stop_gradient(found), inverted[:, 4])  # dz/ds is its last column

    per_panel = jax.vmap(node, (0, 0, None, None, None))
    nodes, moved, speeds = jax.vmap(per_panel)(s, guess, chart[owner], anchor[owner], anchor_s[owner])
    slip_sign, joint_sign, missed = _signs(stop_gradient(speeds), owner, resolution)
    pairs = system.candidates.lower.shape[0]
    contact = jnp.where(march.end < pairs, march.end, (march.end - pairs) % 4)
    why = jnp.select([march.end < 0, march.end < pairs, march.end < pairs + 8], [NO_END, MADE, LEFT], UNTIL)
    return Wire(
        status=(missed | (moved.max() > _share(nodes, 3 / 8))).astype(int),
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


def _interpolate(march, places, s, u):
    """Cubic Hermite guess of `z` at every `s` from the march's nodes."""
    right = jnp.clip(jnp.searchsorted(march.s, s), 1, jnp.maximum(march.n - 1, 1))
    left = right - 1
    width = march.s[right] - march.s[left]
    width = jnp.where(jnp.isfinite(width) & (width > 0), width, 1.0)[..., None]
    f = ((s - march.s[left])[..., None]) / width
    slope = [march.x[k] / jnp.einsum("pni,pi->pn", march.x[k], u)[..., None] * width for k in (left, right)]
    low, high = march.z[left], march.z[right]
    return (
        low * (1 + 2 * f) * (1 - f) ** 2
        + high * f**2 * (3 - 2 * f)
        + slope[0] * f * (1 - f) ** 2
        + slope[1] * f**2 * (f - 1)
    )


def _signs(values, owner, resolution):
    """Signs of slips and joint speeds of each piece, and whether any node contradicts its piece's sign."""
    total = jax.ops.segment_sum(values.sum(1), owner, resolution.pieces)
    tolerance = _share(values, 5 / 8)
    signs = _signs_of(total, tolerance)
    missed = jnp.any(values * signs[owner][:, None] < -tolerance) | ~jnp.all(jnp.isfinite(values))
    return signs[:, :4], signs[:, 4:], missed
