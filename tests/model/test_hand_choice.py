"""The hand that is chosen for a part: it closes, its fingers are apart, and the part rests where it tips last."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import shapely
from shapely import affinity

from wholearm_jax.model import choose_hand, edge_on_palm, polygon, resting_configuration, resting_edges

PARTS = {
    "box": [(0, 0), (60, 0), (60, 40), (0, 40)],
    "bracket": [(0, 0), (60, 0), (60, 20), (20, 20), (20, 50), (0, 50)],
    "triangle": [(0, 0), (40, 0), (20, 50)],
    "tall": [(0, 0), (0, -50), (30, -50), (30, 0)],
    "trapezoid": [(0, 0), (56, 0), (42, 21), (14, 21)],
    "disc": [(30 * np.cos(a), 30 * np.sin(a)) for a in np.linspace(0, 2 * np.pi, 40, endpoint=False)],
}


def segments(hand, angles):
    """The fingers as segments of the plane."""
    joints, lengths = np.asarray(hand.joint), np.asarray(hand.length)
    tips = joints + lengths[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return [shapely.LineString([joint, tip]) for joint, tip in zip(joints, tips, strict=True)]


@pytest.mark.parametrize("scale", [1e-3, 1e-2])
@pytest.mark.parametrize("name", PARTS)
def test_the_fingers_close_on_the_part_without_meeting(name, scale):
    vertices = scale * np.array(PARTS[name], float)
    shape = polygon(vertices, 0.1, 0.1)
    choice = choose_hand(shape)
    z = resting_configuration(shape, choice.hand, choice.edge, choice.x)
    part = shapely.Polygon(vertices)
    centre = part.centroid.coords[0]
    placed = affinity.translate(affinity.rotate(part, z[2], centre, use_radians=True), *(z[:2] - centre))
    fingers = segments(choice.hand, z[3:])
    assert fingers[0].distance(fingers[1]) > 0.01 * (choice.width + choice.height)
    for finger in fingers:
        assert finger.distance(placed) < 1e-9 * scale * 1e3
        assert finger.intersection(placed.buffer(-1e-6 * scale * 1e3)).length == 0
    assert placed.bounds[1] == pytest.approx(0.0, abs=1e-12)
    low, _, high, top = placed.bounds
    assert (choice.width, choice.height) == pytest.approx((high - low, top))
    assert low > float(choice.hand.joint[1, 0])
    assert high < float(choice.hand.joint[0, 0])


@pytest.mark.parametrize("name", PARTS)
def test_fingertips_are_away_from_the_corners_that_they_touch(name):
    """At a corner a first slide would end at once: the trapezoid's was 0.1 mm long."""
    vertices = 1e-3 * np.array(PARTS[name], float)
    shape = polygon(vertices, 0.1, 0.1)
    choice = choose_hand(shape)
    z = resting_configuration(shape, choice.hand, choice.edge, choice.x)
    centre = shapely.Polygon(vertices).centroid.coords[0]
    placed = affinity.translate(
        affinity.rotate(shapely.MultiPoint(vertices), z[2], centre, use_radians=True), *(z[:2] - centre)
    )
    for finger in segments(choice.hand, z[3:]):
        tip = shapely.Point(finger.coords[1])
        corners = [corner for corner in placed.geoms if finger.distance(corner) < 1e-8] or placed.geoms
        assert min(tip.distance(corner) for corner in corners) > 0.05 * (choice.width + choice.height)


def test_a_part_rests_where_it_tips_last():
    """The tipping angle of a box is that between its diagonal and its upright."""
    edges = resting_edges(np.array(PARTS["box"], float) - [30, 20])
    assert [edge for edge, _ in edges] == [0, 2, 1, 3]
    assert edges[0][1] == pytest.approx(np.arctan2(30, 20))
    assert edges[2][1] == pytest.approx(np.arctan2(20, 30))


def test_a_part_stands_on_the_edge_that_is_asked_for():
    box = polygon(1e-3 * np.array(PARTS["box"], float), 0.1, 0.1)
    standing = choose_hand(box, edge=1)
    assert standing.edge == 1
    assert (standing.width, standing.height) == pytest.approx((0.04, 0.06))
    bracket = polygon(1e-3 * np.array(PARTS["bracket"], float), 0.1, 0.1)
    with pytest.raises(ValueError, match=r"lies at rest on e0, .*not on e3"):  # in the notch
        choose_hand(bracket, edge=3)


def test_a_part_that_is_not_convex_stands_on_two_of_its_vertices():
    """A star on any two neighbouring points: its tipping angle is a fifth of a half turn."""
    angles = np.pi / 5 * np.arange(10)
    radii = np.where(np.arange(10) % 2, 0.012, 0.03)[:, None]
    star = radii * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    edges = resting_edges(star)
    assert sorted(edge for edge, _ in edges) == [0, 2, 4, 6, 8]
    half, height = 0.03 * np.sin(np.pi / 5), 0.03 * np.cos(np.pi / 5)
    np.testing.assert_allclose([angle for _, angle in edges], np.arctan2(half, height))
    choice = choose_hand(polygon(star, 0.1, 0.1), edge=4)
    z = resting_configuration(polygon(star, 0.1, 0.1), choice.hand, choice.edge, choice.x)
    placed = affinity.rotate(shapely.Polygon(star), z[2], (0, 0), use_radians=True)
    assert -placed.bounds[1] == pytest.approx(height) == pytest.approx(z[1])
    assert choice.width == pytest.approx(placed.bounds[2] - placed.bounds[0])


def test_an_arch_stands_on_two_feet():
    arch = np.array([(0, 0), (12, 0), (12, 20), (48, 20), (48, 0), (60, 0), (60, 40), (0, 40)], float) / 1e3
    about_centre = arch - shapely.Polygon(arch).centroid.coords[0]
    assert sorted(edge for edge, _ in resting_edges(about_centre)) == [0, 5, 6, 7]
    shape = polygon(arch, 0.1, 0.1)
    choice = choose_hand(shape, edge=0)
    z = resting_configuration(shape, choice.hand, 0, choice.x)
    assert z[2] == pytest.approx(0.0)
    assert edge_on_palm(shape, z) == 0


@pytest.mark.parametrize(("height", "side"), [(0.0, 1), (0.0, -1), (0.01, 1), (0.01, -1)])
def test_a_part_does_not_lie_on_a_joint(height, side):
    """A box 60 mm wide whose end has come 0.1 mm beyond a joint, under which no finger could come out."""
    shape = polygon(1e-3 * np.array(PARTS["box"], float), 0.1, 0.1)
    hand = choose_hand(shape).hand
    hand = eqx.tree_at(lambda h: h.joint, hand, jnp.asarray([[0.05, height], [-0.05, height]]))
    resting_configuration(shape, hand, 0, side * (0.02 - 1e-4))  # beside it, a finger stands upright
    with pytest.raises(ValueError, match=f"lies on the joint of finger{1 if side > 0 else 2}"):
        resting_configuration(shape, hand, 0, side * (0.02 + 1e-4))
