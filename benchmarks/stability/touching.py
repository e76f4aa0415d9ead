"""Objects between the links of a hand so that contacts touch.

The object is dropped onto the palm, the fingers close until they meet it, and a random line in `(x, phi)` is searched
for a place where one of the three touching features is about to be replaced by another. There both touch, which makes
four contacts. Closing a finger of edge offset `d` onto a vertex at polar coordinates `(r, alpha)` about its joint needs
`theta = alpha - asin(d / r)`; its tip meets an edge on the circle of radius `sqrt(l^2 + d^2)`. The left finger is the
right one seen in a mirror.
"""

from typing import NamedTuple

import numpy as np

from benchmarks.stability.shapes import CAPACITY, Shape
from tests.reference.mechanics import Model

ROLLS = np.array([[0, 0, 1, 2], [0, 1, 1, 2], [0, 1, 2, 2]])  # which of three contacts has two rows


class Closed(NamedTuple):
    """An object on the palm between closed fingers: `z`, the touching features as link-wise (kind, feature), and
    whether everything touches; all with leading axes."""

    z: np.ndarray
    kind: np.ndarray
    feature: np.ndarray
    valid: np.ndarray


def closed(shape: Shape, x, phi) -> Closed:
    """Drop the objects at `x`, `phi` (scenes, places) onto the palm and close both fingers onto them."""
    c, s = np.cos(phi)[..., None], np.sin(phi)[..., None]
    px, py = shape.vertices[:, None, :, 0], shape.vertices[:, None, :, 1]
    real = (np.arange(CAPACITY) < shape.count[:, None])[:, None]
    away = np.stack([c * px - s * py, s * px + c * py], axis=3)
    low = np.argmin(np.where(real, away[..., 1], np.inf), axis=2)
    y = -np.take_along_axis(away[..., 1], low[..., None], axis=2)[..., 0]
    points = away + np.stack([x, y], axis=2)[:, :, None]
    where = np.take_along_axis(points[..., 0], low[..., None], axis=2)[..., 0]
    valid = (where > shape.joint[:, 1, :1]) & (where < shape.joint[:, 0, :1])
    theta, kind, feature = [], [np.zeros_like(low)], [low]
    for finger, mirror in ((0, 1.0), (1, -1.0)):
        phase_schedule = points - shape.joint[:, None, None, finger]
        phase_schedule = phase_schedule * np.array([mirror, 1.0])
        angle, k, f = _close(phase_schedule, real, shape.count, shape.length[:, finger], shape.offset[:, finger])
        theta.append(np.where(mirror > 0, angle, np.pi - angle))
        kind.append(k)
        feature.append(f)
        valid &= np.isfinite(angle)
    z = np.stack([x, y, phi, *theta], axis=2)
    return Closed(z, np.stack(kind, axis=2), np.stack(feature, axis=2), valid)


def _close(points, real, count, length, offset):
    """The least angle in (0, pi) at which a finger about the origin meets the points or the edges between them."""
    length, offset = length[:, None, None], offset[:, None, None]
    r, alpha = np.hypot(points[..., 0], points[..., 1]), np.arctan2(points[..., 1], points[..., 0])
    vertex = alpha - np.arcsin(np.clip(offset / np.maximum(r, 1e-12), -1, 1))
    along = np.sqrt(np.maximum(r**2 - offset**2, 0))
    vertex = np.where(real & (r > offset) & (along <= length) & (vertex > 0), vertex, np.inf)
    after = np.where(np.arange(CAPACITY) + 1 < count[:, None], np.arange(CAPACITY) + 1, 0)
    following = np.take_along_axis(points, np.broadcast_to(after[:, None, :, None], points.shape), axis=2)
    edge = following - points
    a = (edge**2).sum(3)
    b = (points * edge).sum(3)
    reach = length**2 + offset**2
    root = b**2 - np.maximum(a, 1e-30) * (r**2 - reach)
    both = (-b[..., None] + np.array([-1.0, 1.0]) * np.sqrt(np.maximum(root, 0))[..., None]) / np.maximum(a, 1e-30)[
        ..., None
    ]
    tip = points[..., None, :] + both[..., None] * edge[..., None, :]
    tips = np.arctan2(tip[..., 1], tip[..., 0]) - np.arctan2(offset, length)[..., None]
    hits = (real & (root > 0))[..., None] & (both > 0) & (both < 1) & (tips > 0)
    tips = np.where(hits, tips, np.inf).min(3)
    every = np.concatenate([vertex, tips], axis=2)
    first = np.argmin(every, axis=2)
    angle = np.take_along_axis(every, first[..., None], axis=2)[..., 0]
    return np.where(angle < np.pi, angle, np.inf), first // CAPACITY, first % CAPACITY


def touching(rng, shape, *, symmetric, places=40, rounds=46):
    """Formations of four contacts that touch: where one touching feature replaces another along a line in (x, phi)."""
    n = len(shape.count)
    span = shape.joint[:, 0, 0] - shape.joint[:, 1, 0]
    x0 = shape.joint[:, 1, 0] + span * rng.uniform(0.1, 0.9, n)
    phi0 = rng.uniform(-np.pi, np.pi, n)
    slope = rng.normal(size=(n, 2)) * np.stack([span / 2, np.full(n, 1.5)], axis=1)
    slope[rng.random(n) < 0.25, 0] = 0.0
    slope[rng.random(n) < 0.15, 1] = 0.0
    if symmetric:
        upright = rng.random(n) < 0.7
        x0[upright], slope[upright, 0], phi0[upright] = 0.0, 0.0, rng.uniform(-0.3, 0.3, int(upright.sum()))

    def at(t, rows=slice(None)):
        small = Shape(*(column[rows] for column in shape))
        return closed(small, x0[rows, None] + slope[rows, :1] * t, phi0[rows, None] + slope[rows, 1:] * t)

    t = np.broadcast_to(np.linspace(0, 1, places), (n, places))
    grid = at(t)
    same = (grid.kind[:, 1:] == grid.kind[:, :-1]) & (grid.feature[:, 1:] == grid.feature[:, :-1])
    change = grid.valid[:, 1:] & grid.valid[:, :-1] & ((~same).sum(2) == 1)
    # Any of the changes on the line, chosen at random.
    pick = np.argmax(change * rng.random(change.shape), axis=1)
    rows = np.flatnonzero(change.any(1))
    low, high = t[rows, pick[rows]][:, None], t[rows, pick[rows] + 1][:, None]
    first, last = at(low, rows), at(high, rows)
    for _ in range(rounds):
        middle = (low + high) / 2
        half = at(middle, rows)
        stays = np.all((half.kind == first.kind) & (half.feature == first.feature), axis=2)
        low, high = np.where(stays, middle, low), np.where(stays, high, middle)
    first, last = at(low, rows), at(high, rows)
    steady = np.abs(first.z - last.z).max(2)[:, 0] < 1e-9
    steady &= first.valid[:, 0] & last.valid[:, 0]
    link = np.arange(3)
    before = np.stack([np.broadcast_to(link, first.kind[:, 0].shape), first.kind[:, 0], first.feature[:, 0]], axis=2)
    after = np.stack([np.broadcast_to(link, last.kind[:, 0].shape), last.kind[:, 0], last.feature[:, 0]], axis=2)
    new = np.any(before != after, axis=2)
    steady &= new.sum(1) == 1
    extra = np.take_along_axis(after, np.argmax(new, axis=1)[:, None, None], axis=1)
    formation = np.concatenate([before, extra], axis=1)
    small = Shape(*(column[rows][steady] for column in shape))
    z = first.z[:, 0][steady]
    formation = shuffled(rng, formation[steady])
    # A tip exactly at a vertex gives paths that begin at the limit of a feature: interesting, but not so often.
    keep = ~_pinned(formation, small.count) | (rng.random(len(z)) < 0.3)
    keep &= _free_roots(small, formation, z)
    return Shape(*(column[keep] for column in small)), formation[keep], z[keep], np.ones(int(keep.sum()), bool)


def _free_roots(shape, formation, z):
    """Whether the fingers' roots and the palm's ends lie outside the object."""
    model = Model.in_object_units(shape, formation, np.zeros((len(z), 3)), np.ones((len(z), 2)))
    return model.depth_of_corners(z[:, None])[:, 0] < 1e-9


def _pinned(formation, count):
    """Whether a formation holds a vertex on a finger and that finger's tip on an edge beside this vertex."""
    link, kind, feature = (formation[..., k] for k in range(3))
    vertex, tip = (kind == 0)[:, :, None], (kind == 1)[:, None]
    after = (feature + 1) % count[:, None]
    beside = (feature[:, :, None] == feature[:, None]) | (feature[:, :, None] == after[:, None])
    return (vertex & tip & beside & (link[:, :, None] == link[:, None])).any((1, 2))


def rolling(rng, shape):
    """Three contacts that touch, one of which rolls: four rows, its gap's and behind it its slip's."""
    n = len(shape.count)
    span = shape.joint[:, 0, 0] - shape.joint[:, 1, 0]
    x = shape.joint[:, 1, 0] + span * rng.uniform(0.1, 0.9, n)
    near = closed(shape, x[:, None], rng.uniform(-np.pi, np.pi, (n, 1)))
    keep = np.flatnonzero(near.valid[:, 0])
    link = np.broadcast_to(np.arange(3), (len(keep), 3))
    three = shuffled(rng, np.stack([link, near.kind[keep, 0], near.feature[keep, 0]], axis=2))
    formation = np.take_along_axis(three, ROLLS[rng.integers(0, 3, len(keep))][:, :, None], axis=1)
    shape, z = Shape(*(column[keep] for column in shape)), near.z[keep, 0]
    good = _free_roots(shape, formation, z)
    return Shape(*(column[good] for column in shape)), formation[good], z[good], np.ones(int(good.sum()), bool)


def flush(rng, shape):
    """A side that lies flush on a link, held by one of its two vertices; one of the three contacts rolls."""
    shape, four, z, _ = touching(rng, shape, symmetric=False)
    link, kind = four[..., 0], four[..., 1]
    twin = (link[:, :, None] == link[:, None]) & (kind == 0)[:, :, None] & (kind == 0)[:, None] & ~np.eye(4, dtype=bool)
    keep = np.flatnonzero(twin.any((1, 2)))
    dropped = np.argmax(twin[keep].any(2) * rng.random((len(keep), 4)), axis=1)
    left = np.argsort(np.arange(4) == dropped[:, None], axis=1, kind="stable")[:, :3]
    three = np.take_along_axis(four[keep], left[..., None], axis=1)
    formation = np.take_along_axis(three, ROLLS[rng.integers(0, 3, len(keep))][:, :, None], axis=1)
    return Shape(*(column[keep] for column in shape)), formation, z[keep], np.ones(len(keep), bool)


def shuffled(rng, formation):
    order = np.argsort(rng.random(formation.shape[:2]), axis=1)
    return np.take_along_axis(formation, order[..., None], axis=1)


def arbitrary(rng, shape):
    """Any four different contacts from a configuration that may be far from all of them."""
    n = len(shape.count)
    span = shape.joint[:, 0, 0] - shape.joint[:, 1, 0]
    x = shape.joint[:, 1, 0] + span * rng.uniform(-0.1, 1.1, n)
    phi = rng.uniform(-np.pi, np.pi, n)
    near = closed(shape, x[:, None], phi[:, None])
    z = near.z[:, 0]
    z[:, 3:] = np.where(np.isfinite(z[:, 3:]), z[:, 3:], rng.uniform(0, np.pi, (n, 2)))
    link = rng.choice(3, (n, 4), p=[0.3, 0.35, 0.35])
    kind = ((rng.random((n, 4)) < 0.25) & (link > 0)).astype(int)
    feature = np.floor(rng.random((n, 4)) * shape.count[:, None]).astype(int)
    # Half of them take what touches and one contact more.
    take = rng.random(n) < 0.6
    formation = np.stack([link, kind, feature], axis=2)
    formation[take, :3] = np.stack(
        [np.broadcast_to(np.arange(3), (n, 3)), near.kind[:, 0], near.feature[:, 0]], axis=2
    )[take]
    code = formation @ np.array([1000, 100, 1])
    distinct = np.array([len(set(row)) == 4 for row in code.tolist()])
    return Shape(*(c[distinct] for c in shape)), formation[distinct], z[distinct], np.zeros(int(distinct.sum()), bool)


def tangential_rows(formation):
    """Rows that repeat the contact before them: the slips of contacts that roll."""
    same = np.all(formation[:, 1:] == formation[:, :-1], axis=2)
    return np.concatenate([np.zeros((len(formation), 1), bool), same], axis=1)
