"""Random scenes for the stability sweep: objects, hands and formations over many decades, all in NumPy.

A scene is drawn in the object's own units (its largest radius is 1) and then scaled. Most are built so that their four
contacts touch: the object is dropped onto the palm, the fingers close until they meet it, and a random line in
`(x, phi)` is searched for a place where one of the three touching features is about to be replaced by another. There
both touch, which makes four contacts. Closing a finger of edge offset `d` onto a vertex at polar coordinates
`(r, alpha)` about its joint needs `theta = alpha - asin(d / r)`; its tip meets an edge on the circle of radius
`sqrt(l^2 + d^2)`. The left finger is the right one seen in a mirror.
"""

from functools import partial
from typing import NamedTuple

import numpy as np

from tests.reference.mechanics import Model, centroid_and_inertia

CAPACITY = 16
TOUCHING, SYMMETRIC, WEDGED, ROLLING, FREE = range(5)
FAMILIES = ("touching", "symmetric", "near singular", "rolling", "arbitrary")
SHARES = (0.58, 0.12, 0.10, 0.10, 0.10)
KNOTS = 24
ROLLS = np.array([[0, 0, 1, 2], [0, 1, 1, 2], [0, 1, 2, 2]])  # which of three contacts has two rows


BLOCK = 2000  # scenes from one seed, so that results do not depend on how many processes share the work


class Scenes(NamedTuple):
    """A batch of scenes in SI units, one row each; names as in `wholearm_jax.model.scene`.

    `uniform` says that the inertia follows from a uniform density; `exact` that `rough` lies within `jitter` of a
    configuration in which all contacts touch. `family` is a row of `FAMILIES`. `torque_kind` and what follows describe
    the torque (see `programs.drive`): `knots` are times as shares of the duration.
    """

    vertices: np.ndarray
    count: np.ndarray
    mass: np.ndarray
    inertia: np.ndarray
    uniform: np.ndarray
    friction: np.ndarray
    joint: np.ndarray
    length: np.ndarray
    offset: np.ndarray
    joint_inertia: np.ndarray
    viscous: np.ndarray
    dry: np.ndarray
    torque_limit: np.ndarray
    gravity: np.ndarray
    link: np.ndarray
    kind: np.ndarray
    feature: np.ndarray
    tangential: np.ndarray
    rough: np.ndarray
    coordinate: np.ndarray
    sign: np.ndarray
    until_coordinate: np.ndarray
    until_value: np.ndarray
    duration: np.ndarray
    at_rest: np.ndarray
    exact: np.ndarray
    family: np.ndarray
    knots: np.ndarray
    stepped: np.ndarray
    torque_kind: np.ndarray
    pace: np.ndarray
    noise: np.ndarray

    def __getitem__(self, rows):
        """A smaller batch (a batch is indexed by scene, not by field)."""
        return (
            Scenes(*(column[rows] for column in self)) if not isinstance(rows, int) else tuple.__getitem__(self, rows)
        )


class Shape(NamedTuple):
    """Objects and hands in object units: `vertices` about the centroid, padded; `count`; the hands' geometry."""

    vertices: np.ndarray
    count: np.ndarray
    joint: np.ndarray
    length: np.ndarray
    offset: np.ndarray


def draw(count: int, seed: int) -> Scenes:
    """`count` random scenes; the same for the same seed."""
    rng = np.random.default_rng(seed)
    wanted = np.bincount(rng.choice(len(SHARES), count, p=SHARES), minlength=len(SHARES))
    parts = [_family(rng, family, int(n)) for family, n in enumerate(wanted) if n]
    together = Scenes(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))
    return together[rng.permutation(count)]


def _family(rng, family, count):
    shape, formation, z, exact = _placed(rng, family, count)
    return _scaled(rng, family, shape, formation, z, exact)


def _placed(rng, family, count):
    """Shapes, formations (link, kind, feature) and configurations in object units."""
    parts, have = [], 0
    while have < count:
        n = max(256, 3 * (count - have) // 2)
        shape = _shapes(rng, n, symmetric=family == SYMMETRIC)
        place = {FREE: _arbitrary, ROLLING: _rolling}.get(family, partial(_touching, symmetric=family == SYMMETRIC))
        parts.append(place(rng, shape))
        have += len(parts[-1][2])
    shape, formation, z, exact = (
        Shape(*(np.concatenate(c)[:count] for c in zip(*(p[0] for p in parts), strict=True))),
        *(np.concatenate([p[k] for p in parts])[:count] for k in (1, 2, 3)),
    )
    return shape, formation, z, exact


def _log_uniform(rng, low, high, size):
    return np.exp(rng.uniform(np.log(low), np.log(high), size))


# --- shapes ----------------------------------------------------------------------------------------------------------


def _shapes(rng, n, *, symmetric):
    count = rng.integers(3, 13, n)
    number = np.arange(CAPACITY)
    spread = np.where(rng.random(n) < 0.5, 0.2, 0.02)[:, None]
    angle = 2 * np.pi * (number + spread * rng.uniform(-1, 1, (n, CAPACITY))) / count[:, None]
    angle += rng.uniform(0, 2 * np.pi, (n, 1))
    star = (rng.random(n) < 0.3)[:, None]
    radius = np.where(star, rng.uniform(0.45, 1.0, (n, CAPACITY)), 1.0)
    flat = np.where(rng.random(n) < 0.3, _log_uniform(rng, 0.05, 1.0, n), rng.uniform(0.6, 1.0, n))
    if symmetric:
        # Regular polygons and rectangles, up to errors from nothing to a thousandth.
        angle = 2 * np.pi * (number + 0.5) / count[:, None] - np.pi / 2
        radius, flat = np.ones_like(radius), np.where(count == 4, rng.uniform(0.3, 1.0, n), 1.0)
    vertices = np.stack([radius * np.cos(angle), flat[:, None] * radius * np.sin(angle)], axis=2)
    if symmetric:
        vertices += _slight(rng, n)[:, None, None] * rng.normal(size=vertices.shape)
    else:
        # A vertex close to the next one, or on the line between its neighbours.
        close = rng.random(n) < 0.06
        vertices[close, 1] = vertices[close, 0] + (vertices[close, 1] - vertices[close, 0]) * _log_uniform(
            rng, 1e-5, 1e-1, (int(close.sum()), 1)
        )
        straight = (rng.random(n) < 0.06) & (count > 3)
        vertices[straight, 1] = vertices[straight][:, [0, 2]].mean(1)
    last = vertices[np.arange(n), count - 1]
    vertices = np.where((number < count[:, None])[..., None], vertices, last[:, None])
    vertices -= centroid_and_inertia(vertices, count)[0][:, None]
    vertices /= np.sqrt((vertices**2).sum(2)).max(1)[:, None, None]
    return Shape(vertices, count, *_hands(rng, n, vertices, symmetric=symmetric))


def _slight(rng, n):
    """Nothing for a third of the rows, else 1e-14 to 1e-3."""
    return np.where(rng.random(n) < 1 / 3, 0.0, _log_uniform(rng, 1e-14, 1e-3, n))


def _hands(rng, n, vertices, *, symmetric):
    half = _log_uniform(rng, 0.7, 4.0, n)
    shift = rng.uniform(-0.5, 0.5, n)
    height = np.where(rng.random((n, 2)) < 0.7, 0.0, rng.uniform(-0.5, 0.0, (n, 2)))
    length = _log_uniform(rng, 0.8, 8.0, (n, 2))
    alike = rng.random(n) < 0.5
    length[alike, 1] = length[alike, 0]
    offset = np.where(rng.random((n, 2)) < 0.5, 0.0, rng.uniform(0.0, 0.3, (n, 2)))
    if symmetric:
        # Now and then the palm is exactly as wide as the object: two fingers upright along parallel sides.
        width = np.ptp(vertices[..., 0], axis=1) / 2
        half = np.where(rng.random(n) < 0.5, width * (1 + _slight(rng, n)), half)
        shift, height, offset = 0 * shift, 0 * height, 0 * offset
        length[:, 1] = length[:, 0]
    joint = np.stack(
        [np.stack([shift + half, height[:, 0]], axis=1), np.stack([shift - half, height[:, 1]], axis=1)], axis=1
    )
    return joint, length, offset


# --- touching configurations -----------------------------------------------------------------------------------------


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


def _touching(rng, shape, *, symmetric, places=40, rounds=46):
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
    formation = _shuffled(rng, formation[steady])
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


def _rolling(rng, shape):
    """Three contacts that touch, one of which rolls: four rows, its gap's and behind it its slip's."""
    n = len(shape.count)
    span = shape.joint[:, 0, 0] - shape.joint[:, 1, 0]
    x = shape.joint[:, 1, 0] + span * rng.uniform(0.1, 0.9, n)
    near = closed(shape, x[:, None], rng.uniform(-np.pi, np.pi, (n, 1)))
    keep = np.flatnonzero(near.valid[:, 0])
    link = np.broadcast_to(np.arange(3), (len(keep), 3))
    three = _shuffled(rng, np.stack([link, near.kind[keep, 0], near.feature[keep, 0]], axis=2))
    formation = np.take_along_axis(three, ROLLS[rng.integers(0, 3, len(keep))][:, :, None], axis=1)
    shape, z = Shape(*(column[keep] for column in shape)), near.z[keep, 0]
    good = _free_roots(shape, formation, z)
    return Shape(*(column[good] for column in shape)), formation[good], z[good], np.ones(int(good.sum()), bool)


def _shuffled(rng, formation):
    order = np.argsort(rng.random(formation.shape[:2]), axis=1)
    return np.take_along_axis(formation, order[..., None], axis=1)


def _arbitrary(rng, shape):
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


# --- scales, frictions, durations, torques ---------------------------------------------------------------------------


def _scaled(rng, family, shape, formation, z, exact):
    n = len(z)
    size, mass = _log_uniform(rng, 1e-3, 10.0, n), _log_uniform(rng, 1e-4, 1e3, n)
    friction = np.where(rng.random((n, 1)) < 0.5, rng.uniform(0, 1.5, (n, 1)), rng.uniform(0, 1.5, (n, 3)))
    friction = np.where(rng.random((n, 1)) < 0.5, friction * 0.3, friction)
    friction[rng.random(n) < 0.1] = 0.0
    gravity = np.where(rng.random(n) < 0.6, 9.81, _log_uniform(rng, 1e-3, 1e3, n)) * (rng.random(n) > 0.08)
    tilt = np.where(rng.random(n) < 0.6, 0.0, rng.uniform(-np.pi, np.pi, n))
    fall = np.sqrt(size / np.maximum(gravity, 1e-3))
    duration = fall * _log_uniform(rng, 1e-2, 1e3, n)
    uniform = rng.random(n) < 0.8
    own = mass * size**2 * _log_uniform(rng, 1e-3, 1.0, n)
    rotary, pace = mass * size**2, 1 / np.minimum(duration, fall)
    joint_inertia = rotary[:, None] * _log_uniform(rng, 1e-3, 1e2, (n, 2))
    viscous = rotary[:, None] * pace[:, None] * _log_uniform(rng, 1e-4, 10.0, (n, 2)) * (rng.random((n, 2)) > 0.2)
    weight = (mass * size * np.maximum(gravity, size * pace**2))[:, None]
    dry = weight * _log_uniform(rng, 1e-4, 0.3, (n, 2)) * (rng.random((n, 2)) > 0.2)
    if family == WEDGED:
        friction = _nearly_singular(rng, shape, formation, z, friction, joint_inertia / rotary[:, None])
    jitter = np.where(rng.random(n) < 0.3, 0.0, _log_uniform(rng, 1e-8, 1e-2, n))
    rough = z + jitter[:, None] * rng.normal(size=z.shape)
    shift = size[:, None] * rng.uniform(-5, 5, (n, 2)) * (rng.random((n, 1)) < 0.3)
    until = np.where(rng.random(n) < 0.12, rng.integers(0, 5, n), -1)
    ahead = z[np.arange(n), until] + rng.uniform(-0.5, 0.5, n)
    scale = np.stack([size, size, *np.ones((3, n))], axis=1)
    knots, stepped = _knots(rng, n)
    kind = rng.choice(4, n, p=[0.7, 0.14, 0.08, 0.08])
    return Scenes(
        vertices=shape.vertices * size[:, None, None] + shift[:, None],
        count=shape.count,
        mass=mass,
        inertia=own,
        uniform=uniform,
        friction=friction,
        joint=shape.joint * size[:, None, None],
        length=shape.length * size[:, None],
        offset=shape.offset * size[:, None],
        joint_inertia=joint_inertia,
        viscous=viscous,
        dry=dry,
        torque_limit=weight * _log_uniform(rng, 0.3, 100.0, (n, 1)) * np.ones(2),
        gravity=np.stack([gravity * np.sin(tilt), -gravity * np.cos(tilt)], axis=1),
        link=formation[..., 0],
        kind=formation[..., 1],
        feature=formation[..., 2],
        tangential=_tangential(formation),
        rough=rough * scale,
        coordinate=_moving(rng, shape, formation, z),
        sign=rng.choice([-1.0, 1.0], n),
        until_coordinate=until,
        until_value=ahead * scale[np.arange(n), until],
        duration=duration,
        at_rest=rng.random(n) < 0.2,
        exact=exact & (jitter < 1e-3),
        family=np.full(n, family),
        knots=knots,
        stepped=stepped,
        torque_kind=kind,
        pace=_log_uniform(rng, 0.3, 3.0, n),
        noise=_noise(rng, n, kind),
    )


def _moving(rng, shape, formation, z):
    """A coordinate that the path moves, mostly; in one scene of twenty any."""
    n = len(z)
    model = Model.in_object_units(shape, formation, np.zeros((n, 3)), np.ones((n, 2)))
    model.tangential = _tangential(formation)
    x = np.abs(model.tangent(z[:, None], np.ones(5))[0][:, 0]) + 1e-9
    rate = np.cumsum(np.where(rng.random((n, 1)) < 0.05, 1.0, np.where(x > 1e-3, x, 0.0) + 1e-12), axis=1)
    return (rng.random((n, 1)) * rate[:, -1:] > rate).sum(1)


def _noise(rng, n, kind):
    """Disturbances of the torque at its knots; half of the driven motions (kind 0) have hardly any."""
    calm = (kind == 0) & (rng.random(n) < 0.5)
    size = np.where(calm, _log_uniform(rng, 1e-6, 1e-2, n), _log_uniform(rng, 1e-2, 1.0, n))
    return size[:, None, None] * rng.normal(size=(n, KNOTS, 2))


def _tangential(formation):
    """Rows that repeat the contact before them: the slips of contacts that roll."""
    same = np.all(formation[:, 1:] == formation[:, :-1], axis=2)
    return np.concatenate([np.zeros((len(formation), 1), bool), same], axis=1)


def _knots(rng, n):
    """Knot times as shares of the duration, increasing from 0 to at least 1; a third of the schedules have steps."""
    gap = rng.gamma(rng.choice([0.5, 4.0, 1e6], n)[:, None], size=(n, KNOTS - 1))
    gap /= gap.sum(1, keepdims=True)
    stepped = rng.random(n) < 1 / 3
    # No three knots at one time: only odd gaps may vanish.
    step = stepped[:, None] & (rng.random((n, KNOTS - 1)) < 0.3) & (np.arange(KNOTS - 1) % 2 == 1)
    gap = np.where(step, 0.0, gap + 1e-6)
    times = np.concatenate([np.zeros((n, 1)), np.cumsum(gap, axis=1)], axis=1)
    return times / times[:, -1:] * np.where(rng.random(n) < 0.5, 1.0, rng.uniform(1.0, 1.3, n))[:, None], stepped


def _nearly_singular(rng, shape, formation, z, friction, joint_inertia):
    """Scale friction until the 5x5 matrix at the start is nearly singular (relative distance 1e-12 to 1e-1)."""
    model = Model.in_object_units(shape, formation, friction, joint_inertia)
    scale = np.geomspace(0.05, 20.0, 60)
    values = np.stack([model.determinant(z, k) for k in scale], axis=1)
    flips = values[:, 1:] * values[:, :-1] < 0
    found = flips.any(1)
    first = np.argmax(flips, axis=1)
    low, high = scale[first], scale[np.minimum(first + 1, len(scale) - 1)]
    sign = np.sign(values[np.arange(len(first)), first])
    for _ in range(60):
        middle = (low + high) / 2
        stays = np.sign(model.determinant(z, middle)) == sign
        low, high = np.where(stays, middle, low), np.where(stays, high, middle)
    near = low * (1 + rng.choice([-1.0, 1.0], len(low)) * _log_uniform(rng, 1e-12, 1e-1, len(low)))
    scaled = friction * np.where(found, near, 1.0)[:, None]
    return np.where((scaled.max(1) <= 1.5)[:, None], scaled, friction)


def as_data(scenes: Scenes, row: int) -> dict:
    """One scene as the nested data of a scene file (see `wholearm_jax.parse`), to look into it alone."""
    one = {name: value[row] for name, value in scenes._asdict().items()}
    links, kinds, coordinates = ("palm", "finger1", "finger2"), "ve", ("x", "y", "phi", "theta1", "theta2")
    rows = zip(one["link"], one["kind"], one["feature"], strict=True)
    names = [f"{links[a]}:{kinds[b]}{c}" for a, b, c in rows]
    rolls = [*one["tangential"][1:], False]
    contacts = [
        name + " rolling" * bool(roll)
        for name, roll, skip in zip(names, rolls, one["tangential"], strict=True)
        if not skip
    ]
    fingers = {
        f"finger{k + 1}": {
            "joint": one["joint"][k].tolist(),
            "length": float(one["length"][k]),
            "offset": float(one["offset"][k]),
            "inertia": float(one["joint_inertia"][k]),
            "viscous": float(one["viscous"][k]),
            "dry": float(one["dry"][k]),
            "torque_limit": float(one["torque_limit"][k]),
        }
        for k in (0, 1)
    }
    solid = {
        "vertices": one["vertices"][: one["count"]].tolist(),
        "mass": float(one["mass"]),
        "friction": dict(zip(links, one["friction"].tolist(), strict=True)),
    }
    solid |= {} if one["uniform"] else {"inertia": float(one["inertia"])}
    phase = {
        "name": "phase",
        "contacts": contacts,
        "toward": coordinates[one["coordinate"]] + ("+" if one["sign"] > 0 else "-"),
        "duration": float(one["duration"]),
        "arrive": "rest" if one["at_rest"] else "moving",
    }
    if one["until_coordinate"] >= 0:
        phase["until"] = {coordinates[one["until_coordinate"]]: float(one["until_value"])}
    start = dict(zip(coordinates, one["rough"].tolist(), strict=True))
    return {
        "title": "a random scene",
        "gravity": one["gravity"].tolist(),
        "hand": fingers,
        "object": solid,
        "start": start,
        "phase": [phase],
    }
