"""A hand to start from: proportions with which both fingers close on an object at rest, with room to move it.

The hand is a scaled copy of one design. Its size follows from the object's: the joints stand close beside it, so that
the fingers lean on it rather than lie on it, and the fingers reach well over it. Inertia, friction and torque limit of
the joints are those of the design for the finger's length and the object's weight, so that a larger or heavier part
asks for the same shares of them.
"""

import itertools
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from wholearm_jax.core import as_device_array
from wholearm_jax.model.hand_collisions import link_overlaps
from wholearm_jax.model.resting import hull_edges, lying_angle, resting_angle, resting_configuration
from wholearm_jax.model.scene import Hand, Polygon, RigidBody, rigid_body

GRAVITY = 9.81  # [m/s^2], of the loads that the joints are made for
SPAN = (1.3, 1.15, 1.45, 1.6)  # distance of the joints over the object's width at rest, in the order of preference
REACH = (1.1, 0.85, 0.7, 0.55, 0.4)  # length of the fingers over the sum of the object's width and height at rest
CLEARANCE = (0.15, 0.02)  # least distance between the fingers at the start, over that sum: wanted, and accepted
TIP_DISTANCE = (0.05, 0.0)  # least of a fingertip from a vertex that its finger touches, over that sum: likewise
TOUCHING = 1e-6  # distance from a finger at which a vertex touches it, over its length
# The design, made dimensionless by the object's mass m, gravity g and the fingers' length L.
JOINT_INERTIA = 0.6  # m L^2
JOINT_VISCOSITY = 0.7  # m g L sqrt(L / g)
JOINT_DRY_FRICTION = 0.04  # m g L
JOINT_TORQUE_LIMIT = 4.0  # m g L
_DIGITS = 4  # to which lengths are rounded [m]


class HandChoice(NamedTuple):
    """A hand, and how an object begins in it: at rest on an edge, midway between the joints."""

    hand: Hand
    edge: int
    x: float  # of the centre of mass [m]
    tipping_angle: float  # [rad] by which the object may be turned over either end of the edge before it tips
    width: float  # of the object at rest [m]
    height: float


def choose_hand(shape: Polygon, edge: int | None = None) -> HandChoice:
    """Choose a hand for an object, and an edge to begin on.

    Args:
        shape: the object.
        edge: number of the edge to begin on; None: the steadiest on which a hand closes on the object.

    Raises:
        ValueError: if the object cannot rest on that edge, or no hand of the design closes on it.
    """
    body = rigid_body(shape)
    corners = np.asarray(body.vertices)[: int(body.count)]
    edges = resting_edges(corners)
    allowed = [row for row in edges if edge is None or row[0] == edge]
    if not allowed:
        raise ValueError(f"the object lies at rest on {', '.join(f'e{k}' for k, _ in sorted(edges))}, not on e{edge}")
    for clearance, (on, tipping_angle) in itertools.product(CLEARANCE, allowed):
        at = _rotated(corners, resting_angle(corners, on))
        width, height = np.ptp(at, axis=0).tolist()
        x = round(-(at[:, 0].min() + at[:, 0].max()) / 2, _DIGITS) + 0.0
        size = width + height
        for tip_distance, span, reach in itertools.product(TIP_DISTANCE, SPAN, REACH):
            hand = scaled_hand(span * width, reach * size, float(body.mass))
            if _fits(shape, hand, on, x, clearance * size, tip_distance * size):
                return HandChoice(hand, on, x, tipping_angle, width, height)
    where = "any edge on which it can lie" if edge is None else f"e{edge}"
    raise ValueError(f"no hand closes on the object on {where}")


def resting_edges(corners: Float[np.ndarray, "count 2"]) -> list[tuple[int, float]]:
    """List the edges of its convex hull on which a polygon lies at rest, the steadiest first.

    Args:
        corners: vertices about the centre of mass [m].

    Returns:
        Each edge, named after its first vertex, with the angle [rad] by which the object may be turned over either of
        its ends before it tips.
    """
    rows = []
    for edge, last in hull_edges(corners).items():
        at = _rotated(corners, lying_angle(corners, edge, last))
        height, down = -at[edge, 1], np.flatnonzero(at[:, 1] <= at[edge, 1] + 1e-9 * np.ptp(corners))
        left, right = -at[down, 0].min(), at[down, 0].max()
        if at[edge, 0] <= -left and min(left, right) > 0:  # of sides that rounding splits, the first
            rows.append((edge, float(np.arctan2(min(left, right), height))))
    return sorted(rows, key=lambda row: (-round(row[1], 9), row[0]))


def scaled_hand(span: float, length: float, mass: float) -> Hand:
    """Build the hand of the design with joints `span` apart, for objects of a mass.

    Args:
        span: distance of the joints [m].
        length: of the fingers [m].
        mass: of the object [kg].
    """
    half_span, length = round(span / 2, _DIGITS), round(length, _DIGITS)
    load = mass * GRAVITY * length
    design = {
        "inertia": JOINT_INERTIA * mass * length**2,
        "viscous": JOINT_VISCOSITY * load * np.sqrt(length / GRAVITY),
        "dry": JOINT_DRY_FRICTION * load,
        "torque_limit": JOINT_TORQUE_LIMIT * load,
    }
    values = {key: as_device_array([float(f"{value:.3g}")] * 2) for key, value in design.items()}
    return Hand(
        joint=as_device_array([[half_span, 0.0], [-half_span, 0.0]]),
        length=as_device_array([length, length]),
        offset=as_device_array([0.0, 0.0]),
        back=as_device_array([0.0, 0.0]),
        range=as_device_array([[0.0, np.pi]] * 2),
        layered=as_device_array(False),
        clearance=as_device_array(0.0),
        **values,
    )


def _rotated(corners: np.ndarray, phi: float) -> np.ndarray:
    """Turn a polygon about its centre of mass."""
    turn = np.array([[np.cos(phi), -np.sin(phi)], [np.sin(phi), np.cos(phi)]])
    return corners @ turn.T


def _fits(shape: Polygon, hand: Hand, edge: int, x: float, clearance: float, tip_distance: float) -> bool:
    """Say whether both fingers close on the object on an edge, apart from one another, their tips from what they touch.

    Where a fingertip is at a vertex that it touches, or touches an edge at its end, a first slide would end at once.
    """
    try:
        z = resting_configuration(shape, hand, edge, x)
    except ValueError:
        return False
    apart = float(link_overlaps(hand, as_device_array(z[3:]))[0]) < -clearance
    return apart and _distance_of_tips(rigid_body(shape), hand, np.asarray(z)) >= tip_distance


def _distance_of_tips(body: RigidBody, hand: Hand, z: Float[np.ndarray, "5"]) -> float:
    """Return the least distance of a fingertip from a vertex [m]: of those that its finger touches, or else of any."""
    corners = _rotated(np.asarray(body.vertices)[: int(body.count)], z[2]) + z[:2]
    found = []
    for joint, length, theta in zip(np.asarray(hand.joint), np.asarray(hand.length), z[3:], strict=True):
        along, aside = _rotated(corners - joint, -theta).T
        touching = (np.abs(aside) < TOUCHING * length) & (along > 0) & (along <= length * (1 + TOUCHING))
        near = touching if touching.any() else np.full(len(along), True)
        found.append(np.hypot(along - length, aside)[near].min())
    return float(min(found))
