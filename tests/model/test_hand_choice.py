"""The hand that is chosen for a part: it closes, its fingers are apart, and the part rests where it tips last."""

import numpy as np
import pytest
import shapely
from shapely import affinity

from wholearm_jax.model import choose_hand, polygon, resting_configuration, resting_edges

PARTS = {
    "box": [(0, 0), (60, 0), (60, 40), (0, 40)],
    "bracket": [(0, 0), (60, 0), (60, 20), (20, 20), (20, 50), (0, 50)],
    "triangle": [(0, 0), (40, 0), (20, 50)],
    "tall": [(0, 0), (0, -50), (30, -50), (30, 0)],
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
    with pytest.raises(ValueError, match=r"lies at rest on e0, .*not on e2"):  # the notch's floor
        choose_hand(bracket, edge=2)


def test_a_part_that_lies_on_no_edge_is_refused():
    """A star of five points stands on two of them."""
    angles = np.pi / 5 * np.arange(10)
    radii = np.where(np.arange(10) % 2, 0.012, 0.03)[:, None]
    star = radii * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    with pytest.raises(ValueError, match="none of its edges"):
        choose_hand(polygon(star, 0.1, 0.1))
