r"""March: follow the curve `z(s)` of a formation in short steps until something ends it, and remember the nodes.

Each step predicts the next node by the cubic through the last two and their tangents, and corrects it by Newton's
method on the C-functions in the plane `u . z = s`, `u` being the chart's direction. What is watched on the way: gaps of
contacts that might be made, room on the features of those that hold, a coordinate's limit (each ends the wire where it
turns negative, or dips below zero and returns within a step; a vertex behind a finger where its gap turns positive),
slips and joint speeds (each reversal is a kink), and the sign of `det [G; x]`, which changes where two wires meet.

Derivation: section 3 of `docs/derivation.md`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from wholearm_jax.contacts import (
    along_rates,
    constraint_rows,
    constraints,
    frames,
    gap_rates,
    slips,
)
from wholearm_jax.elimination import inverse, times
from wholearm_jax.lookup import pick
from wholearm_jax.precision import digits
from wholearm_jax.scene import Heading
from wholearm_jax.status import Status
from wholearm_jax.system import System

LONGEST, SHORTEST = 0.06, 2e-3  # march steps, and the step at which an end counts as bracketed
CHARTS = 8  # directions that a wire may be charted by, one after the other


def oriented_tangent(system: System, z, hint):
    """The unit tangent `x` and `det [G; x]`: the product of singular values, which changes sign where wires meet."""
    return _normalised(*inverse(jnp.concatenate([constraint_rows(system.contacts, z), hint[None]])))


def _normalised(inverted, determinant):
    """The same of `[G; hint]^-1` and its determinant."""
    size = jnp.sqrt((inverted[:, 4] ** 2).sum())
    return inverted[:, 4] / size, determinant * size  # hint = x / size + what the rows of G span


def speeds_of(system: System, z, x):
    """What reverses at kinks: the slips of the contacts and the joints' speeds."""
    return jnp.concatenate([slips(system.contacts, z, x), x[3:]])


def signs_of(values, tolerance):
    """Signs, 0 for what is no larger than `tolerance`."""
    return jnp.where(jnp.abs(values) > tolerance, jnp.sign(values), 0.0)


class Watched(NamedTuple):
    """Values that stay positive on a wire (`_watch`), their rates `d/ds`, and places along candidate features."""

    values: Float[Array, "watch"]
    rates: Float[Array, "watch"]
    along: Float[Array, "candidates"]


class March(NamedTuple):
    """Nodes along the wire: `n` of them, in charts numbered by `chart`; the last is where the end was bracketed.

    `orientation` is `det [G; x]` at each; `flips` says what reverses or turns on the way to it from the node before
    (`speeds_of`, then the chart), at what `share` of that way. `speeds` are those of the last node, `sense` the signs
    that they had last. `before` is what is watched at the last node within the wire, `beyond` at the last one tried.
    `end` is the row of `before` that ends the wire (-1: none), about at `end_z`.
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
    before: Watched
    beyond: Watched
    end: Int[Array, ""]
    end_z: Float[Array, "5"]
    status: Int[Array, ""]
    done: Bool[Array, ""]


def march(system: System, heading: Heading, z: Float[Array, "5"], x: Float[Array, "5"], capacity: int) -> March:
    """Follow a wire from `z` along its unit tangent `x` to its end: `max_steps` if `capacity` nodes do not reach it."""
    tolerance = digits(z, 5 / 8)
    sense = jnp.where(heading.until_value < z[heading.until_coordinate], -1.0, 1.0)
    sense = jnp.where(heading.until_coordinate < 0, 1.0, sense)

    def step(m: March) -> March:
        return _step(system, lambda z, x, u: _watch(system, heading, sense, z, x, u), tolerance, m)

    begin = _begin(z, x, system.candidates.lower.shape[0], system.contacts.lower.shape[0], capacity)
    return _ended(system, jax.lax.while_loop(lambda m: ~m.done, step, begin), tolerance)


def _watch(system, heading, sense, z, x, u) -> Watched:
    """What is watched at a place of the wire, and its rates in the chart with direction `u`."""
    pairs, held = frames(system.candidates, z), frames(system.contacts, z)
    slope = x / (u @ x)
    along = along_rates(system.contacts, z, slope)
    coordinate = heading.until_coordinate
    ahead = jnp.where(coordinate < 0, 1.0, (heading.until_value - z[coordinate]) * sense)
    nears = jnp.where(coordinate < 0, 0.0, -slope[coordinate] * sense)
    room = [held.along - system.contacts.lower, system.contacts.upper - held.along]
    return Watched(
        values=jnp.concatenate([pairs.gap, *room, ahead[None]]),
        rates=jnp.concatenate([gap_rates(system.candidates, z, slope), along, -along, nears[None]]),
        along=pairs.along,
    )


def _begin(z, x, pairs: int, slots: int, capacity: int) -> March:
    """A march that has no node yet. Its first step has no length: it looks about at the start."""

    def buffer(row):
        return jnp.zeros((capacity, *row.shape), row.dtype).at[0].set(row)

    none, watch = jnp.zeros(6, z.dtype), pairs + 2 * slots + 1
    nothing = Watched(jnp.full(watch, -jnp.inf, z.dtype), jnp.zeros(watch, z.dtype), jnp.zeros(pairs, z.dtype))
    return March(
        n=jnp.asarray(0, int),
        step=jnp.zeros((), z.dtype),
        z=buffer(z),
        x=buffer(x),
        s=jnp.full(capacity, jnp.inf, z.dtype).at[0].set(0.0),
        speeds=none,
        sense=none,
        flips=jnp.zeros((capacity, 7), bool),
        share=jnp.zeros((capacity, 7), z.dtype),
        orientation=jnp.zeros(capacity, z.dtype),
        chart=jnp.zeros(capacity, int),
        charts=jnp.zeros((CHARTS, 5), z.dtype).at[0].set(x),
        anchors=jnp.zeros((CHARTS, 5), z.dtype).at[0].set(z),
        anchor_s=jnp.zeros(CHARTS, z.dtype),
        number=jnp.asarray(0, int),
        before=nothing,
        beyond=nothing,
        end=jnp.asarray(-1, int),
        end_z=z,
        status=jnp.asarray(0, int),
        done=jnp.asarray(False),
    )


def _step(system, watch, tolerance, m: March) -> March:
    """Try one step: keep its node, take a shorter one, or find that the wire ends within the shortest."""
    capacity = m.s.shape[0]
    last, u = jnp.maximum(m.n - 1, 0), pick(m.charts, m.number)
    z, x, s = pick(m.z, last), pick(m.x, last), pick(m.s, last)
    z_new, moved, inverted, determinant = correct(system, u, _predicted(m), u @ z + m.step, 4, tolerance)
    x_new, orientation = _normalised(inverted, determinant)
    watched = watch(z_new, x_new, u)
    good = (moved < tolerance) & (x_new @ x > 0.98) & jnp.all(jnp.isfinite(x_new))
    crossed, _ = crossings(system, m.before, watched, m.step, tolerance)
    ends = good & jnp.any(crossed)
    bracketed = ends & (m.step <= SHORTEST)
    accept = good & ~jnp.any(crossed)
    place = jnp.where(accept | bracketed, m.n, capacity)
    turn = accept & (u @ x_new < 0.6)
    number = m.number + turn
    chart_row = jnp.where(turn, number, CHARTS)
    s_new = s + m.step
    speeds = speeds_of(system, z_new, x_new)
    sign = signs_of(speeds, tolerance)
    flips = sign * m.sense < 0
    share = jnp.where(flips, jnp.clip(m.speeds / jnp.where(flips, m.speeds - speeds, 1.0), 0.0, 1.0), 0.0)
    shorter = jnp.where(ends, jnp.maximum(m.step / 4, SHORTEST), m.step / 2)
    lost = ~good & (m.step < 1e-6)
    full = (m.n + 1 >= capacity) | (number >= CHARTS)
    in_chart = watched._replace(rates=watched.rates * jnp.where(turn, u @ x_new, 1.0))
    return m._replace(
        n=m.n + (accept | bracketed),
        step=jnp.where(accept, jnp.where(m.n > 0, jnp.minimum(m.step * 1.5, LONGEST), LONGEST), shorter),
        z=m.z.at[place].set(z_new, mode="drop"),
        x=m.x.at[place].set(x_new, mode="drop"),
        s=m.s.at[place].set(s_new, mode="drop"),
        speeds=jnp.where(accept, speeds, m.speeds),
        sense=jnp.where(accept & (sign != 0), sign, m.sense),
        flips=m.flips.at[place].set(jnp.append(flips, m.number != pick(m.chart, last)), mode="drop"),
        share=m.share.at[place].set(jnp.append(share, 0.0), mode="drop"),
        orientation=m.orientation.at[place].set(orientation, mode="drop"),
        chart=m.chart.at[place].set(m.number, mode="drop"),
        charts=m.charts.at[chart_row].set(x_new, mode="drop"),
        anchors=m.anchors.at[chart_row].set(z_new, mode="drop"),
        anchor_s=m.anchor_s.at[chart_row].set(s_new, mode="drop"),
        number=number,
        before=jax.tree.map(lambda new, old: jnp.where(accept, new, old), in_chart, m.before),
        beyond=watched,
        status=jnp.select([lost, full & ~bracketed], [int(Status.SINGULAR), int(Status.MAX_STEPS)], 0),
        done=bracketed | lost | full,
    )


def _predicted(m: March):
    """The next node, by the cubic through the last two nodes and their tangents; the first by its tangent alone."""
    u, last = pick(m.charts, m.number), jnp.maximum(m.n - 1, 0)
    before = jnp.maximum(last - 1, 0)
    z, z_before, x, x_before = pick(m.z, last), pick(m.z, before), pick(m.x, last), pick(m.x, before)
    slope, slope_before = x / (u @ x), x_before / (u @ x_before)
    width = jnp.where(m.n > 1, u @ (z - z_before), 1.0)
    mean = jnp.where(m.n > 1, (z - z_before) / width, slope)
    t = m.step / width
    bend = (2 * slope + slope_before - 3 * mean) + (slope + slope_before - 2 * mean) * t
    return z + m.step * (slope + bend * t)


def _ended(system, m: March, tolerance) -> March:
    """What ends the wire first between the last two nodes of a march, and about where."""
    low, high = jnp.maximum(m.n - 2, 0), jnp.maximum(m.n - 1, 1)
    step = jnp.where(m.status == 0, m.s[high] - m.s[low], 1.0)
    crossed, where = crossings(system, m.before, m.beyond, step, tolerance)
    first = jnp.argmin(jnp.where(crossed, where, jnp.inf))
    z = m.z[low] + (m.z[high] - m.z[low]) * where[first]
    found = (m.status == 0) & jnp.any(crossed)
    return m._replace(end=jnp.where(found, first, -1), end_z=jnp.where(found, z, m.end_z))


def correct(system: System, u, z, height, steps: int, enough: ArrayLike = 0.0):
    """Newton in the chart, until a step is no larger than `enough`: the place of the wire on the plane `u.z = height`.

    Beside it the last step's size, and `[G; u]^-1` and its determinant before that step.
    """

    def once(state):
        z, count, *_ = state
        inverted, determinant = inverse(jnp.concatenate([constraint_rows(system.contacts, z), u[None]]))
        left = jnp.concatenate([constraints(system.contacts, z), (u @ z - height)[None]])
        move = times(inverted, left)
        return z - move, count + 1, jnp.abs(move).max(), inverted, determinant

    def going(state):
        _, count, moved, *_ = state
        return (count < steps) & (moved > enough)

    far, eye = jnp.asarray(jnp.inf, z.dtype), jnp.eye(5, dtype=z.dtype)
    start = (z, jnp.asarray(0, int), far, eye, jnp.ones((), z.dtype))
    z, _, moved, inverted, determinant = jax.lax.while_loop(going, once, start)
    return z, jnp.where(jnp.isfinite(moved), moved, jnp.inf), inverted, determinant


def crossings(system, before: Watched, after: Watched, step, tolerance):
    """Which watched values turn negative within a step (or dip below zero and return), and at what share of it.

    The share is a root of the cubic through values and rates: several things that end a wire within the shortest step
    are told apart to 1e-13.
    """
    pairs = system.candidates.lower.shape[0]
    # A vertex behind a link, within its length, stops at its back; one misplaced there comes out.
    behind = (before.values[:pairs] < -tolerance) & system.behind
    sense = jnp.ones_like(before.values).at[:pairs].set(jnp.where(behind, -1.0, 1.0))
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
        at = before.along + (after.along - before.along) * where[:pairs]
        inside = (at >= system.candidates.lower - tolerance) & (at <= system.candidates.upper + tolerance)
        counts = jnp.concatenate([inside & system.watched, jnp.ones(new.shape[0] - pairs, bool)])
        return (through | dips) & counts, where

    return jax.lax.cond(jnp.any(through | dips), placed, lambda: (through & dips, jnp.zeros_like(old)))
