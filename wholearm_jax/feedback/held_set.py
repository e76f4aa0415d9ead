"""What could be held where no law holds the whole set of objects: a smaller set, or the same with stronger motors."""

from typing import NamedTuple

import equinox as eqx

from wholearm_jax.feedback.design import feedback
from wholearm_jax.model import Scene, TorqueSchedule

SHARES = (0.75, 0.5, 0.25)  # of the half widths that are tried
MOTORS = (1.5, 2.0, 3.0)  # torque limits that are tried, over the hand's


class HeldSet(NamedTuple):
    """What a law holds, of what was tried."""

    share: float  # largest share of the half widths; 0: none
    motors: float | None  # smallest factor of the torque limits with which the whole set is held


def held_set(
    scene: Scene, schedule: TorqueSchedule, *, friction: float, mass: float = 0.0, shape: float | None = None
) -> HeldSet:
    """Find the largest of some smaller sets, and the weakest of some stronger hands, for which a law exists.

    Args:
        scene: Scene with its plan.
        schedule: As for `feedback`.
        friction: Half width of each link's friction, relative, of the set that is not held.
        mass: Half width of the mass, relative.
        shape: Half width of the vertices' coordinates [m].
    """

    def holds(share: float, motors: float) -> bool:
        hand = eqx.tree_at(lambda s: s.hand.torque_limit, scene, motors * scene.hand.torque_limit)
        smaller = shape and share * shape
        return feedback(hand, schedule, friction=share * friction, mass=share * mass, shape=smaller).margin > 0

    share = next((share for share in SHARES if holds(share, 1.0)), 0.0)
    return HeldSet(share, next((motors for motors in MOTORS if holds(1.0, motors)), None))
