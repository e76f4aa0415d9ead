"""Obstacles among links: gaps and overlaps against shapely's polygons, which know nothing of the table."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import shapely
from shapely import LineString, Point, Polygon
from support import layered

from wholearm_jax.model import link_obstacles, link_overlaps
from wholearm_jax.model.hand_collisions import LINK_OBSTACLES, LinkMeeting
from wholearm_jax.model.kinematics import contact_kinematics

COUNT = 400
depths_of = jax.jit(jax.vmap(link_overlaps))


@pytest.fixture(scope="module")
def hands():
    """Random hands, half of them of segments, with random joint angles."""
    rng = np.random.default_rng(0)
    hand = layered("heptagon").hand
    strips = (rng.uniform(size=COUNT) < 0.5)[:, None]
    drawn = eqx.tree_at(
        lambda h: (h.joint, h.length, h.offset, h.back, h.layered),
        jax.tree.map(lambda a: jnp.broadcast_to(a, (COUNT, *a.shape)), hand),
        (
            jnp.asarray(rng.uniform(-0.01, 0.01, (COUNT, 2, 2)) + np.array([[0.045, 0.0], [-0.045, 0.0]])),
            jnp.asarray(rng.uniform(0.05, 0.15, (COUNT, 2))),
            jnp.asarray(strips * rng.uniform(0.0, 0.015, (COUNT, 2))),
            jnp.asarray(strips * rng.uniform(0.0, 0.01, (COUNT, 2))),
            jnp.zeros(COUNT, bool),
        ),
    )
    return jax.tree.map(np.asarray, drawn), rng.uniform(-0.4, np.pi + 0.4, (COUNT, 2))


def finger_polygon(hand, k, finger, angle) -> Polygon | LineString:
    """The finger's strip in the world."""
    joint, length, offset, back = (a[k, finger] for a in (hand.joint, hand.length, hand.offset, hand.back))
    along = np.array([np.cos(angle), np.sin(angle)])
    across = (1, -1)[finger] * np.array([-along[1], along[0]])
    tip = joint + length * along
    corners = [joint + offset * across, tip + offset * across, tip - back * across, joint - back * across]
    return Polygon(corners) if offset + back > 0 else LineString([joint, tip])


def test_depth_is_positive_where_polygons_overlap(hands):
    hand, angles = hands
    depths = np.asarray(depths_of(hand, angles))
    overlapping = np.zeros(COUNT, bool)
    for k in range(COUNT):
        first, second = (finger_polygon(hand, k, f, float(angles[k, f])) for f in range(2))
        overlapping[k] = first.intersects(second)
    assert 40 < overlapping.sum() < COUNT - 40
    np.testing.assert_array_equal(depths[:, 0] > 0, overlapping)
    beyond = np.maximum(-np.asarray(angles), np.asarray(angles) - np.pi)
    np.testing.assert_allclose(depths[:, 3:], beyond, atol=1e-15)


def test_depth_is_positive_where_fingers_are_nearer_than_their_clearance(hands):
    """Between a corner and a face the nearest distance; between two corners one up to the root of 2 larger counts."""
    hand, angles = hands
    clearance = 0.004
    kept = eqx.tree_at(lambda h: h.clearance, hand, np.full(COUNT, clearance))
    depths = np.asarray(depths_of(kept, angles))[:, 0]
    near = np.zeros(COUNT, int)
    for k in range(COUNT):
        first, second = (finger_polygon(hand, k, f, float(angles[k, f])) for f in range(2))
        distance = first.distance(second)
        assert (depths[k] > 0) >= (distance < clearance)
        assert (depths[k] > 0) <= (distance < np.sqrt(2) * clearance)
        near[k] = 0 < distance < clearance
    assert near.sum() > 5
    np.testing.assert_allclose(depths - clearance, np.asarray(depths_of(hand, angles))[:, 0], atol=1e-15)


def test_a_shift_by_the_depth_separates_two_strips(hands):
    """The depth is the least distance: no shift of less than it, in any of many directions, separates the fingers."""
    hand, angles = hands
    depths = np.asarray(depths_of(hand, angles))[:, 0]
    checked = 0
    for k in np.flatnonzero(depths > 1e-3)[:40]:
        first, second = (finger_polygon(hand, k, f, float(angles[k, f])) for f in range(2))
        directions = np.linspace(0, 2 * np.pi, 2000, endpoint=False)
        ways = np.stack([np.cos(directions), np.sin(directions)], axis=1)[:, None]
        outline = shapely.get_coordinates(first)
        make = shapely.polygons if isinstance(first, Polygon) else shapely.linestrings

        def apart(distance, second=second, ways=ways, outline=outline, make=make):
            return not shapely.intersects(make(outline + distance * ways), second).all()

        assert apart(1.001 * depths[k])
        assert not apart(0.999 * depths[k])
        checked += 1
    assert checked > 15


def measured(hand, z):
    """The rows of a hand, and each as a contact."""
    rows = link_obstacles(hand)
    return rows, contact_kinematics(rows.contacts, z)


def test_gaps_are_distances_of_corners(hands):
    """Each row's gap against the distance of the same corner and line by shapely."""
    hand, angles = hands
    z = np.concatenate([np.zeros((COUNT, 3)), angles], axis=1)
    rows, at = jax.tree.map(np.asarray, jax.jit(jax.vmap(measured))(hand, z))
    compared = 0
    for k in range(0, COUNT, 7):
        for row, obstacle in enumerate(LINK_OBSTACLES):
            if obstacle.meeting != LinkMeeting.FINGER_ON_FINGER or obstacle.on_tip_face:
                continue
            link, other = obstacle.link - 1, 2 - obstacle.link
            height = (hand.offset, -hand.back)[obstacle.corner[1]][k, link]
            angle = float(angles[k, link])
            along = np.array([np.cos(angle), np.sin(angle)])
            across = (1, -1)[link] * np.array([-along[1], along[0]])
            corner = np.asarray(hand.joint[k, link]) + float(height) * across
            corner = corner + obstacle.corner[0] * float(hand.length[k, link]) * along
            place, length = float(at.along[k, row]), float(hand.length[k, other])
            if 0 < place < length:
                outside = abs(float(at.gap[k, row])) - float(rows.half_width[k, row])
                expected = finger_polygon(hand, k, other, float(angles[k, other])).distance(Point(corner))
                assert max(outside, 0.0) == pytest.approx(expected, abs=1e-12)
                compared += 1
    assert compared > 100


def test_layered_fingers_pass_each_other(hands):
    hand, angles = hands
    layered = eqx.tree_at(lambda h: h.layered, hand, jnp.ones(COUNT, bool))
    depths = depths_of(layered, angles)
    assert float(depths[:, 0].max()) == -np.inf
    np.testing.assert_array_equal(depths[:, 1:], depths_of(hand, angles)[:, 1:])
