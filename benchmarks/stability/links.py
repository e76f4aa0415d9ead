"""Links as bodies, by segments: how deep fingers are in each other, below the palm or beyond their range, in NumPy.

A finger is a rectangle: from its joint to `length`, between its contact edge and its back. Everything is in object
units; leading axes are (scenes, places). Two segments that cross do so by the least of the four distances of an end of
one from the other's line, a corner in a rectangle by its distance from the nearest side: no overlap is that much deep
without being an overlap.
"""

from typing import NamedTuple

import numpy as np

from tests.reference.mechanics import dot, quarter

SIDES = (1.0, -1.0)
SURFACE = 1e-6  # of a finger's length, below the palm's surface, from which on its tip is below and all of it counts


class Links(NamedTuple):
    """Hands in object units, a row a scene."""

    joint: np.ndarray
    length: np.ndarray
    offset: np.ndarray
    back: np.ndarray
    range: np.ndarray
    layered: np.ndarray

    @classmethod
    def of(cls, scenes, size):
        """From `scenes.Scenes`, which are in SI units."""
        lengths = [scenes.joint / size[:, None, None]]
        lengths += [a / size[:, None] for a in (scenes.length, scenes.offset, scenes.back)]
        return cls(*lengths, scenes.range, scenes.layered)

    def take(self, rows):
        """The same for some of the scenes."""
        return Links(*(a[rows] for a in self))


def corners(links, z):
    """Each finger's corners in turn (scenes, places, 2, 4, 2): joint and tip on the contact edge, tip and joint on the
    back."""
    found = []
    for k, side in enumerate(SIDES):
        d = np.stack([np.cos(z[..., 3 + k]), np.sin(z[..., 3 + k])], axis=-1)
        edge = links.joint[:, None, k] + side * links.offset[:, None, k, None] * quarter(d)
        back = links.joint[:, None, k] - side * links.back[:, None, k, None] * quarter(d)
        reach = links.length[:, None, k, None] * d
        found.append(np.stack([edge, edge + reach, back + reach, back], axis=2))
    return np.stack(found, axis=2)


def crossing(a, b, c, d):
    """By how much segments from `a` to `b` and from `c` to `d` cross; 0 where they do not."""

    def heights(start, stop, point):
        line = stop - start
        return dot(quarter(line), point - start) / np.maximum(np.sqrt(dot(line, line)), 1e-300)

    of_c, of_d, of_a, of_b = heights(a, b, c), heights(a, b, d), heights(c, d, a), heights(c, d, b)
    least = np.min(np.abs([of_a, of_b, of_c, of_d]), axis=0)
    return np.where((of_a * of_b < 0) & (of_c * of_d < 0), least, 0.0)


def distance(point, start, stop):
    """How far points are from segments."""
    line = stop - start
    share = np.clip(dot(point - start, line) / np.maximum(dot(line, line), 1e-300), 0.0, 1.0)
    left = point - start - share[..., None] * line
    return np.sqrt(dot(left, left))


def _sides(rectangle):
    """The sides of rectangles (..., 4, 2), start and stop."""
    return rectangle, np.roll(rectangle, -1, axis=-2)


def between(links, z):
    """How deep one finger is in the other, whether they share a plane or not."""
    first, second = np.moveaxis(corners(links, z), 2, 0)
    (a, b), (c, d) = _sides(first), _sides(second)
    worst = crossing(a[..., :, None, :], b[..., :, None, :], c[..., None, :, :], d[..., None, :, :]).max((-1, -2))
    for inner, outer in ((first, second), (second, first)):
        root, tip, _, behind = np.moveaxis(outer, -2, 0)
        along, across = tip - root, behind - root
        away = inner - root[..., None, :]
        inside = np.full(inner.shape[:-1], np.inf)
        for axis in (along, across):
            size = np.sqrt(dot(axis, axis))[..., None]
            height = dot(away, axis[..., None, :]) / np.maximum(size, 1e-300)
            inside = np.minimum(inside, np.minimum(height, size - height))
        worst = np.maximum(worst, np.maximum(inside, 0.0).max(-1))
    return worst


def below(links, z):
    """How deep a finger whose tip is below the palm's surface is below it, between the palm's ends."""
    ends = np.sort(links.joint[..., 0], axis=1)[:, None]
    worst = np.zeros(z.shape[:2])
    for k, rectangle in enumerate(np.moveaxis(corners(links, z), 2, 0)):
        # The axis, where it is between the palm's ends, and the tip's two corners.
        d = np.stack([np.cos(z[..., 3 + k]), np.sin(z[..., 3 + k])], axis=-1)
        run = links.length[:, None, k, None] * d
        start = np.broadcast_to(links.joint[:, None, k], run.shape)
        across = np.where(run[..., 0] == 0, 1e-300, run[..., 0])
        shares = np.clip((ends - start[..., :1]) / across[..., None], 0.0, 1.0)
        heights = start[..., 1:] + shares * run[..., 1:]
        is_below = (start + run)[..., 1] < -SURFACE * links.length[:, None, k]
        crossed = (np.ptp(shares, axis=-1) > 1e-9) & is_below
        worst = np.maximum(worst, np.where(crossed, -heights.min(-1), 0.0))
        tips = rectangle[..., 1:3, :]
        beside = (tips[..., 0] > ends[..., :1]) & (tips[..., 0] < ends[..., 1:])
        worst = np.maximum(worst, np.where(beside, -tips[..., 1], 0.0).max(-1))
    return worst


def beyond(links, z):
    """How far a joint is beyond its range [rad]."""
    angle = z[..., 3:]
    return np.maximum(np.maximum(links.range[:, None, :, 0] - angle, angle - links.range[:, None, :, 1]).max(-1), 0.0)


def overlap(links, z):
    """How deep links are in one another, or beyond a range, at most."""
    fingers = np.where(links.layered[:, None], 0.0, between(links, z))
    return np.max([fingers, below(links, z), beyond(links, z)], axis=0)


def behind_in_object(model, links, z):
    """How deep the back and the tip's face of a finger with a thickness are in the object: sides that cross."""
    points, following, real = model.outline(z)
    worst = np.zeros(z.shape[:2])
    for rectangle in np.moveaxis(corners(links, z), 2, 0):
        for begin, end in ((1, 2), (2, 3)):
            start, stop = rectangle[..., None, begin, :], rectangle[..., None, end, :]
            deep = np.where(real, crossing(start, stop, points, following), 0.0)
            worst = np.maximum(worst, deep.max(-1))
    return worst


def meet(links, z, tolerance):
    """Whether links touch, or a joint is at the end of its range (scenes, places)."""
    both = corners(links, z)
    first, second = np.moveaxis(both, 2, 0)
    gaps = []
    for inner, outer in ((first, second), (second, first)):
        start, stop = _sides(outer)
        gaps.append(distance(inner[..., :, None, :], start[..., None, :, :], stop[..., None, :, :]).min((-1, -2)))
    fingers = ~links.layered[:, None] & (np.min(gaps, axis=0) < tolerance)
    palm = (np.abs(both[..., 1:3, 1]) < tolerance).any((-1, -2))
    for k in (0, 1):
        end = links.joint[:, None, 1 - k] * [1.0, 0.0]
        start, stop = _sides(both[:, :, k])
        palm |= distance(end[..., None, :], start, stop).min(-1) < tolerance
    limits = (np.abs(links.range[:, None] - z[..., 3:, None]) < tolerance).any((-1, -2))
    return fingers | palm | limits
