r"""Obstacles among the hand's links, as contacts of points of one link against faces of another.

A finger is a strip of the plane: from its joint to its tip, between its contact edge and its back. Two such strips that
move apart or together first touch where a corner of one meets a face of the other, so that these gaps suffice:

- the corners of each finger against the other finger's long faces, and its tip's corners against the other's tip;
- the corners of each fingertip against the palm's surface, and the palm's end at the other finger against each finger's
  long faces. A finger and the palm's end beside its own joint are mounted on one another and never count as meeting.

Both long faces of a finger are one row: the gap is measured from the strip's middle line, and a corner touches where it
is half the strip's width, `half_width`, on either side. Fingers that must keep a clearance meet where a corner of one
comes to the other's strip widened and lengthened by it. The ends of the joints' ranges complete the table; they are no
contacts, but linear in the joint angles.

Derivation: section 3 of `docs/derivation.md`.
"""

import enum
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from wholearm_jax.model.kinematics import CORNER_TOL, Carrier, ContactSet
from wholearm_jax.model.scene import Hand

FINGER_COUNT = 2


class LinkMeeting(enum.IntEnum):
    """What meets in a row of `LinkObstacles`."""

    FINGER_ON_FINGER = 0  # a corner of finger `link` against the other finger
    TIP_ON_PALM = 1
    PALM_END_ON_FINGER = 2
    LEAST_ANGLE = 3
    LARGEST_ANGLE = 4


class LinkObstacle(NamedTuple):
    """One row: what meets, and whose corner, tip, face or joint it is (1 or 2)."""

    meeting: LinkMeeting
    link: int
    corner: tuple[int, int] = (0, 0)  # at the joint or the tip (0, 1), on the contact edge or the back (0, 1)
    on_tip_face: bool = False
    palm_end: int = 0  # beside finger 1 or finger 2


def _rows() -> tuple[LinkObstacle, ...]:
    fingers, sides = (1, 2), (0, 1)
    corners = [(end, side) for end in (1, 0) for side in sides]
    return (
        *(LinkObstacle(LinkMeeting.FINGER_ON_FINGER, link, corner) for link in fingers for corner in corners),
        *(LinkObstacle(LinkMeeting.FINGER_ON_FINGER, link, (1, side), True) for link in fingers for side in sides),
        *(LinkObstacle(LinkMeeting.TIP_ON_PALM, link, (1, side)) for link in fingers for side in sides),
        *(LinkObstacle(LinkMeeting.PALM_END_ON_FINGER, link, palm_end=3 - link) for link in fingers),
        *(
            LinkObstacle(kind, link)
            for kind in (LinkMeeting.LEAST_ANGLE, LinkMeeting.LARGEST_ANGLE)
            for link in fingers
        ),
    )


LINK_OBSTACLES = _rows()
"""All rows, in the order of precedence among those that are met at the same place."""


class LinkObstacles(eqx.Module):
    """The gaps of `LINK_OBSTACLES`: `gap C + joint_angle . theta + shift`, C being the row's gap as a contact."""

    contacts: ContactSet
    gap: Float[Array, "rows"]
    joint_angle: tuple[Float[Array, "rows"], Float[Array, "rows"]]
    shift: Float[Array, "rows"]
    half_width: Float[Array, "rows"]
    two_sided: Bool[Array, "rows"]  # whether the gap may have either sign
    exists: Bool[Array, "rows"]


def _column(function) -> np.ndarray:
    return np.array([function(row) for row in LINK_OBSTACLES])


# The table by columns.
_MEETING = _column(lambda row: int(row.meeting))
_ON_FINGER = _MEETING == LinkMeeting.FINGER_ON_FINGER
_ON_PALM = _MEETING == LinkMeeting.TIP_ON_PALM
_PALM_END = _MEETING == LinkMeeting.PALM_END_ON_FINGER
_IS_ANGLE = _MEETING >= LinkMeeting.LEAST_ANGLE
_ON_TIP = _column(lambda row: row.on_tip_face)
_LINK = _column(lambda row: row.link)
_OTHER = 3 - _LINK
_AT_TIP, _ON_BACK = _column(lambda row: row.corner[0]), _column(lambda row: row.corner[1])
_BESIDE = np.maximum(_column(lambda row: row.palm_end), 1)
# Whose point, and against whose line: of a tip's face the roles of link and object change, as in contacts of type B.
_POINT_LINK = np.where(_PALM_END | _IS_ANGLE, 0, np.where(_ON_TIP, _OTHER, _LINK))
_LINE_LINK = np.where(_ON_PALM | _IS_ANGLE, 0, np.where(_ON_FINGER & ~_ON_TIP, _OTHER, _LINK))
_SIDE = np.array([1.0, 1.0, -1.0])


def _of_finger(link: np.ndarray) -> np.ndarray:
    """Weights of fingers 1 and 2 in each row."""
    return np.stack([link == 1, link == 2], axis=1).astype(float)


def link_obstacles(hand: Hand) -> LinkObstacles:
    """Gather the gaps among a hand's links, in the hand's own unit of length."""
    one = jnp.ones(len(LINK_OBSTACLES), hand.length.dtype)
    middle, half_width = strip_middle(hand)
    heights = jnp.stack([hand.offset, -hand.back])  # of the contact edge and the back, by finger
    corner_height = heights[_ON_BACK, _LINK - 1]
    corner_reach = hand.length[_LINK - 1] * _AT_TIP
    line, point = _of_finger(_LINE_LINK), _of_finger(_POINT_LINK)
    line_length, on_palm = line @ hand.length, _LINE_LINK == 0
    face = _ON_FINGER & _ON_TIP

    # The point: a finger's corner, the palm's end, or of a tip's face the corner at which its edge begins.
    side = _SIDE[_POINT_LINK]
    clearance = jnp.where(_ON_FINGER, hand.clearance, 0.0)
    tip_begins = jnp.stack([(middle - half_width)[0], -(middle + half_width)[1]])[_OTHER - 1]
    point_x = jnp.where(_PALM_END, hand.joint[_BESIDE - 1, 0], jnp.where(face, hand.length[_OTHER - 1], corner_reach))
    point_y = jnp.where(_PALM_END, 0.0, jnp.where(face, tip_begins, side * corner_height))

    palm_lower, palm_upper = hand.joint[1, 0], hand.joint[0, 0]
    width = 2 * half_width[_OTHER - 1]
    contacts = ContactSet(
        on_link=jnp.asarray(~face),
        finger=(jnp.asarray(line[:, 0]), jnp.asarray(line[:, 1])),
        side=jnp.asarray(_SIDE[_LINE_LINK]),
        joint=tuple((line @ hand.joint).T),
        reach=jnp.where(face, hand.length[_LINK - 1], line_length),
        offset=jnp.where(face, corner_height, line @ middle),
        point=(point_x * one, point_y * one),
        edge=(0 * one, one),
        lower=jnp.where(on_palm, palm_lower, jnp.where(_PALM_END, CORNER_TOL, -clearance)),
        upper=jnp.where(face, width, jnp.where(on_palm, palm_upper, line_length)) + clearance,
        friction=0 * one,
        tangential=one < 0,
        slides=one < 0,
        rolling_anchor=0 * one,
        carrier=Carrier(0 * one, (jnp.asarray(point[:, 0]), jnp.asarray(point[:, 1])), tuple((point @ hand.joint).T)),
    )
    sign = np.where(_IS_ANGLE, np.where(_MEETING == LinkMeeting.LEAST_ANGLE, 1.0, -1.0), 0.0)
    limit = hand.range[_LINK - 1, (_MEETING == LinkMeeting.LARGEST_ANGLE).astype(int)]
    two_sided = (_ON_FINGER & ~_ON_TIP) | _PALM_END
    return LinkObstacles(
        contacts=contacts,
        gap=jnp.where(_IS_ANGLE, 0.0, one),
        joint_angle=(jnp.asarray(sign * _of_finger(_LINK)[:, 0]), jnp.asarray(sign * _of_finger(_LINK)[:, 1])),
        shift=jnp.asarray(-sign * limit) - jnp.where(face, clearance, 0.0),
        half_width=jnp.where(two_sided, line @ half_width + clearance, 0.0),
        two_sided=jnp.asarray(two_sided),
        exists=jnp.asarray(~_ON_FINGER) | ~hand.layered,
    )


def strip_middle(hand: Hand) -> tuple[Float[Array, "2"], Float[Array, "2"]]:
    """Return the distance of each finger's middle line from its axis toward the object, and half of its width."""
    front, behind = hand.offset, -hand.back
    half_width = jnp.where(front >= behind, front - behind, behind - front) / 2
    return (front + behind) / 2, half_width


@jax.jit
def link_overlaps(hand: Hand, joint_angles: Float[Array, "2"]) -> Float[Array, "5"]:
    """Measure how deep the links of a hand lie in one another.

    Args:
        hand: the hand.
        joint_angles: `theta1` and `theta2` (2,) [rad].

    Returns:
        By how much the fingers lie in one another or are nearer than the hand's clearance, the depth of fingers 1 and 2
        in the palm (all in the hand's unit of length), and how far joints 1 and 2 are beyond their ranges [rad];
        negative where there is no overlap.
    """
    corners, axes, frames = jax.vmap(_strip)(hand.joint, *strip_middle(hand), hand.length, joint_angles, _SIDE[1:])
    # Separating axes of two rectangles: the faces of each.
    separations = []
    for own, other in ((0, 1), (1, 0)):
        place = (corners[other] - hand.joint[own]) @ frames[own].T  # along the finger and across it
        low, high = jnp.stack([jnp.zeros(()), axes[own, 0]]), jnp.stack([hand.length[own], axes[own, 1]])
        separations += [place.min(0) - high, low - place.max(0)]
    between = jnp.where(hand.layered, -jnp.inf, hand.clearance - jnp.concatenate(separations).max())
    palm = jax.vmap(_depth_below_palm, (None, 0, 0, 0))(hand, hand.joint, frames[:, 0], hand.length)
    tips = corners[:, 2:]
    beside = (tips[..., 0] > hand.joint[1, 0]) & (tips[..., 0] < hand.joint[0, 0])
    palm = jnp.maximum(palm, jnp.where(beside, -tips[..., 1], -jnp.inf).max(1))
    beyond = jnp.maximum(hand.range[:, 0] - joint_angles, joint_angles - hand.range[:, 1])
    return jnp.concatenate([between[None], palm, beyond])


def _strip(joint, middle, half_width, length, angle, side):
    """A finger's corners (two at the joint, two at the tip), its faces' heights and its directions along and across."""
    along = jnp.stack([jnp.cos(angle), jnp.sin(angle)])
    across = side * jnp.stack([-along[1], along[0]])
    heights = jnp.stack([middle - half_width, middle + half_width])
    root = joint + heights[:, None] * across
    return jnp.concatenate([root, root + length * along]), heights, jnp.stack([along, across])


def _depth_below_palm(hand: Hand, joint, along, length):
    """Measure how deep a finger whose tip is below the palm's surface reaches below it between the palm's ends."""
    span = jnp.where(along[0] == 0, jnp.finfo(along.dtype).tiny, along[0])
    cuts = (jnp.stack([hand.joint[1, 0], hand.joint[0, 0]]) - joint[0]) / span
    near, far = jnp.clip(cuts.min(), 0.0, length), jnp.clip(cuts.max(), 0.0, length)
    lowest = jnp.minimum(joint[1] + near * along[1], joint[1] + far * along[1])
    # A finger whose joint is below the surface comes out of it where its tip does: there rounding decides nothing.
    is_below = (joint[1] + length * along[1] < -CORNER_TOL * length) & (far - near > CORNER_TOL * length)
    return jnp.where(is_below, -lowest, -jnp.inf)
