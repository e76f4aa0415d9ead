"""The stability sweep's own arithmetic of links against Shapely, and the scenes that it draws."""

import numpy as np
import shapely

from benchmarks.stability.links import Links, below, between, beyond, corners, meet, overlap
from benchmarks.stability.scenes import FAMILIES, draw

COUNT = 300


def random_hands():
    rng = np.random.default_rng(0)
    strips = (rng.random(COUNT) < 0.5)[:, None]
    links = Links(
        joint=rng.uniform(-0.1, 0.1, (COUNT, 2, 2)) + np.array([[0.8, 0.0], [-0.8, 0.0]]),
        length=rng.uniform(0.8, 3.0, (COUNT, 2)),
        offset=strips * rng.uniform(0.0, 0.2, (COUNT, 2)),
        back=strips * rng.uniform(0.0, 0.2, (COUNT, 2)),
        range=np.full((COUNT, 2, 2), [0.0, np.pi]),
        layered=np.zeros(COUNT, bool),
    )
    return links, np.concatenate([np.zeros((COUNT, 1, 3)), rng.uniform(-0.4, np.pi + 0.4, (COUNT, 1, 2))], axis=2)


def test_fingers_overlap_where_shapely_says_so():
    links, z = random_hands()
    deep = between(links, z)[:, 0]
    rectangles = corners(links, z)[:, 0]
    thick = (links.offset + links.back).max(1) > 0
    first, second = (
        np.where(thick, shapely.polygons(rectangles[:, k]), shapely.linestrings(rectangles[:, k, :2])) for k in (0, 1)
    )
    crossing = shapely.intersects(first, second)
    assert 40 < crossing.sum() < COUNT - 40
    np.testing.assert_array_equal(deep > 0, crossing)
    assert not meet(links, z, 1e-9)[~crossing, 0].any()
    assert overlap(links._replace(layered=~links.layered), z)[:, 0].max() > 0  # below the palm, or beyond a range
    np.testing.assert_array_equal(
        overlap(links._replace(layered=~links.layered), z), np.maximum(below(links, z), beyond(links, z))
    )


def test_tips_below_the_palm_and_joints_beyond_their_range():
    links, _ = random_hands()
    links = links.take(np.arange(2))._replace(
        joint=np.array([[[0.8, 0.0], [-0.8, 0.0]]] * 2), length=np.ones((2, 2)), offset=np.zeros((2, 2))
    )
    links = links._replace(back=links.offset)
    z = np.zeros((2, 2, 5))
    z[0, :, 3:], z[1, :, 3:] = [[2.0, 1.0], [2.0, 0.0]], [[np.pi + 0.1, 1.0], [-0.2, 1.0]]
    np.testing.assert_allclose(below(links, z), [[0, 0], [np.sin(0.1), 0]], atol=1e-15)
    np.testing.assert_allclose(beyond(links, z), [[0, 0], [0.1, 0.2]], atol=1e-15)
    np.testing.assert_array_equal(meet(links, z, 1e-9), [[False, True], [False, False]])


def test_scenes_are_of_both_kinds_of_hand_and_begin_flush():
    scenes = draw(200, 1)
    assert 0.3 < scenes.layered.mean() < 0.6
    assert np.bincount(scenes.family, minlength=len(FAMILIES)).min() > 5
