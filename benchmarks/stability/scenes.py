"""Random scenes for the stability sweep: objects, hands and formations over many decades, all in NumPy.

A scene is drawn in the object's own units (`shapes`, `touching`) and then scaled.
"""

from functools import partial
from typing import NamedTuple

import numpy as np

from benchmarks.stability.links import Links, between
from benchmarks.stability.shapes import Shape, log_uniform, shapes
from benchmarks.stability.touching import arbitrary, flush, rolling, tangential_rows, touching
from tests.reference.mechanics import Model

TOUCHING, SYMMETRIC, WEDGED, ROLLING, FREE, FLUSH = range(6)
FAMILIES = ("touching", "symmetric", "near singular", "rolling", "arbitrary", "flush start")
SHARES = (0.50, 0.12, 0.10, 0.10, 0.08, 0.10)
KNOTS = 24
UNLIMITED = 1e3  # [rad], what no joint reaches
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
    back: np.ndarray
    range: np.ndarray
    layered: np.ndarray
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
    flush_tolerance: np.ndarray

    def __getitem__(self, rows):
        """A smaller batch (a batch is indexed by scene, not by field)."""
        return (
            Scenes(*(column[rows] for column in self)) if not isinstance(rows, int) else tuple.__getitem__(self, rows)
        )


def draw(count: int, seed: int) -> Scenes:
    """`count` random scenes; the same for the same seed."""
    rng = np.random.default_rng(seed)
    wanted = np.bincount(rng.choice(len(SHARES), count, p=SHARES), minlength=len(SHARES))
    parts = [_family(rng, family, int(n)) for family, n in enumerate(wanted) if n]
    together = Scenes(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))
    return with_bodies(np.random.default_rng([seed, 1]), together[rng.permutation(count)])


def with_bodies(rng, scenes: Scenes) -> Scenes:
    """The same scenes on hands whose links are bodies: coplanar or layered, with backs and ranges.

    Half of the hands share a plane, but only a quarter of those whose fingers would cross where the scene begins.
    """
    n, size = len(scenes.count), Model.of(scenes).size
    backs = np.where(rng.random((n, 1)) < 0.3, rng.uniform(0.0, 0.2, (n, 2)), 0.0)
    some = scenes._replace(back=backs * size[:, None])
    crossed = between(Links.of(some, size), some.rough[:, None])[:, 0] > 0
    layered = rng.random(n) < np.where(crossed, 0.75, 0.3)
    angle, room = scenes.rough[:, 3:], log_uniform(rng, 0.02, 3.0, (n, 2, 2))
    around = np.stack([angle - room[..., 0], angle + room[..., 1]], axis=2)
    sort = rng.choice(3, (n, 2), p=[0.2, 0.5, 0.3])[..., None]
    limits = np.select([sort == 0, sort == 1], [scenes.range, np.array([0.0, np.pi])], around)
    flush = size * rng.choice([1e-12, 1e-9, 1e-6], n)
    return some._replace(layered=layered, range=limits, flush_tolerance=flush)


def _family(rng, family, count):
    shape, formation, z, exact = _placed(rng, family, count)
    return _scaled(rng, family, shape, formation, z, exact)


def _placed(rng, family, count):
    """Shapes, formations (link, kind, feature) and configurations in object units."""
    parts, have = [], 0
    while have < count:
        n = max(256, 3 * (count - have) // 2)
        # Boxes and regular polygons, and, half of the time, what begins flush.
        symmetric = family == SYMMETRIC or (family == FLUSH and rng.random() < 0.5)
        shape = shapes(rng, n, symmetric=symmetric)
        place = {FREE: arbitrary, ROLLING: rolling, FLUSH: flush}.get(family, partial(touching, symmetric=symmetric))
        parts.append(place(rng, shape))
        have += len(parts[-1][2])
    shape, formation, z, exact = (
        Shape(*(np.concatenate(c)[:count] for c in zip(*(p[0] for p in parts), strict=True))),
        *(np.concatenate([p[k] for p in parts])[:count] for k in (1, 2, 3)),
    )
    return shape, formation, z, exact


def _scaled(rng, family, shape, formation, z, exact):
    n = len(z)
    size, mass = log_uniform(rng, 1e-3, 10.0, n), log_uniform(rng, 1e-4, 1e3, n)
    friction, gravity, tilt = _surroundings(rng, n)
    fall = np.sqrt(size / np.maximum(gravity, 1e-3))
    duration = fall * log_uniform(rng, 1e-2, 1e3, n)
    uniform = rng.random(n) < 0.8
    own = mass * size**2 * log_uniform(rng, 1e-3, 1.0, n)
    rotary, pace = mass * size**2, 1 / np.minimum(duration, fall)
    joint_inertia = rotary[:, None] * log_uniform(rng, 1e-3, 1e2, (n, 2))
    viscous = rotary[:, None] * pace[:, None] * log_uniform(rng, 1e-4, 10.0, (n, 2)) * (rng.random((n, 2)) > 0.2)
    weight = (mass * size * np.maximum(gravity, size * pace**2))[:, None]
    dry = weight * log_uniform(rng, 1e-4, 0.3, (n, 2)) * (rng.random((n, 2)) > 0.2)
    if family == WEDGED:
        friction = _nearly_singular(rng, shape, formation, z, friction, joint_inertia / rotary[:, None])
    jitter = np.where(rng.random(n) < 0.3, 0.0, log_uniform(rng, 1e-8, 1e-2, n))
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
        back=0.0 * shape.offset,
        range=np.full((n, 2, 2), [-UNLIMITED, UNLIMITED]),
        layered=np.ones(n, bool),
        joint_inertia=joint_inertia,
        viscous=viscous,
        dry=dry,
        torque_limit=weight * log_uniform(rng, 0.3, 100.0, (n, 1)) * np.ones(2),
        gravity=np.stack([gravity * np.sin(tilt), -gravity * np.cos(tilt)], axis=1),
        link=formation[..., 0],
        kind=formation[..., 1],
        feature=formation[..., 2],
        tangential=tangential_rows(formation),
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
        pace=log_uniform(rng, 0.3, 3.0, n),
        noise=_noise(rng, n, kind),
        flush_tolerance=1e-9 * size,
    )


def _surroundings(rng, n):
    """Coefficients of friction, and gravity: its size and how the hand is tilted."""
    friction = np.where(rng.random((n, 1)) < 0.5, rng.uniform(0, 1.5, (n, 1)), rng.uniform(0, 1.5, (n, 3)))
    friction = np.where(rng.random((n, 1)) < 0.5, friction * 0.3, friction)
    friction[rng.random(n) < 0.1] = 0.0
    gravity = np.where(rng.random(n) < 0.6, 9.81, log_uniform(rng, 1e-3, 1e3, n)) * (rng.random(n) > 0.08)
    tilt = np.where(rng.random(n) < 0.6, 0.0, rng.uniform(-np.pi, np.pi, n))
    return friction, gravity, tilt


def _moving(rng, shape, formation, z):
    """A coordinate that the path moves, mostly; in one scene of twenty any."""
    n = len(z)
    model = Model.in_object_units(shape, formation, np.zeros((n, 3)), np.ones((n, 2)))
    model.tangential = tangential_rows(formation)
    x = np.abs(model.tangent(z[:, None], np.ones(5))[0][:, 0]) + 1e-9
    rate = np.cumsum(np.where(rng.random((n, 1)) < 0.05, 1.0, np.where(x > 1e-3, x, 0.0) + 1e-12), axis=1)
    return (rng.random((n, 1)) * rate[:, -1:] > rate).sum(1)


def _noise(rng, n, kind):
    """Disturbances of the torque at its knots; half of the driven motions (kind 0) have hardly any."""
    calm = (kind == 0) & (rng.random(n) < 0.5)
    size = np.where(calm, log_uniform(rng, 1e-6, 1e-2, n), log_uniform(rng, 1e-2, 1.0, n))
    return size[:, None, None] * rng.normal(size=(n, KNOTS, 2))


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
    near = low * (1 + rng.choice([-1.0, 1.0], len(low)) * log_uniform(rng, 1e-12, 1e-1, len(low)))
    scaled = friction * np.where(found, near, 1.0)[:, None]
    return np.where((scaled.max(1) <= 1.5)[:, None], scaled, friction)
