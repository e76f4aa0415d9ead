"""Random objects and hands in object units: the object's largest radius is 1."""

from typing import NamedTuple

import numpy as np

from tests.reference.mechanics import centroid_and_inertia

CAPACITY = 16


class Shape(NamedTuple):
    """Objects and hands in object units: `vertices` about the centroid, padded; `count`; the hands' geometry."""

    vertices: np.ndarray
    count: np.ndarray
    joint: np.ndarray
    length: np.ndarray
    offset: np.ndarray


def log_uniform(rng, low, high, size):
    return np.exp(rng.uniform(np.log(low), np.log(high), size))


def shapes(rng, n, *, symmetric):
    count = rng.integers(3, 13, n)
    number = np.arange(CAPACITY)
    spread = np.where(rng.random(n) < 0.5, 0.2, 0.02)[:, None]
    angle = 2 * np.pi * (number + spread * rng.uniform(-1, 1, (n, CAPACITY))) / count[:, None]
    angle += rng.uniform(0, 2 * np.pi, (n, 1))
    star = (rng.random(n) < 0.3)[:, None]
    radius = np.where(star, rng.uniform(0.45, 1.0, (n, CAPACITY)), 1.0)
    flat = np.where(rng.random(n) < 0.3, log_uniform(rng, 0.05, 1.0, n), rng.uniform(0.6, 1.0, n))
    if symmetric:
        # Regular polygons and rectangles, up to errors from nothing to a thousandth.
        angle = 2 * np.pi * (number + 0.5) / count[:, None] - np.pi / 2
        radius, flat = np.ones_like(radius), np.where(count == 4, rng.uniform(0.3, 1.0, n), 1.0)
    vertices = np.stack([radius * np.cos(angle), flat[:, None] * radius * np.sin(angle)], axis=2)
    if symmetric:
        vertices += slight(rng, n)[:, None, None] * rng.normal(size=vertices.shape)
    else:
        # A vertex close to the next one, or on the line between its neighbours.
        close = rng.random(n) < 0.06
        vertices[close, 1] = vertices[close, 0] + (vertices[close, 1] - vertices[close, 0]) * log_uniform(
            rng, 1e-5, 1e-1, (int(close.sum()), 1)
        )
        straight = (rng.random(n) < 0.06) & (count > 3)
        vertices[straight, 1] = vertices[straight][:, [0, 2]].mean(1)
    last = vertices[np.arange(n), count - 1]
    vertices = np.where((number < count[:, None])[..., None], vertices, last[:, None])
    vertices -= centroid_and_inertia(vertices, count)[0][:, None]
    vertices /= np.sqrt((vertices**2).sum(2)).max(1)[:, None, None]
    return Shape(vertices, count, *_hands(rng, n, vertices, symmetric=symmetric))


def slight(rng, n):
    """Nothing for a third of the rows, else 1e-14 to 1e-3."""
    return np.where(rng.random(n) < 1 / 3, 0.0, log_uniform(rng, 1e-14, 1e-3, n))


def _hands(rng, n, vertices, *, symmetric):
    half = log_uniform(rng, 0.7, 4.0, n)
    shift = rng.uniform(-0.5, 0.5, n)
    height = np.where(rng.random((n, 2)) < 0.7, 0.0, rng.uniform(-0.5, 0.0, (n, 2)))
    length = log_uniform(rng, 0.8, 8.0, (n, 2))
    alike = rng.random(n) < 0.5
    length[alike, 1] = length[alike, 0]
    offset = np.where(rng.random((n, 2)) < 0.5, 0.0, rng.uniform(0.0, 0.3, (n, 2)))
    if symmetric:
        # Now and then the palm is exactly as wide as the object: two fingers upright along parallel sides.
        width = np.ptp(vertices[..., 0], axis=1) / 2
        half = np.where(rng.random(n) < 0.5, width * (1 + slight(rng, n)), half)
        shift, height, offset = 0 * shift, 0 * height, 0 * offset
        length[:, 1] = length[:, 0]
    joint = np.stack(
        [np.stack([shift + half, height[:, 0]], axis=1), np.stack([shift - half, height[:, 1]], axis=1)], axis=1
    )
    return joint, length, offset
