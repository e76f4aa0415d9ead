"""The torque with which an object waits: one under which it must stay at rest, if there is one.

Of the torques with nearly the largest margin, that which is farthest from those that move the object along its path is
tried first. Under it friction may let the object slide or tip in another way (`margin.strong_stability`). Then torques
all over the polygon of those that hold the object are tried, and that is taken which is farthest from the others, its
edges included.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from wholearm_jax.core import LinearProgramme
from wholearm_jax.margin import MIN_REST_MARGIN, RestAccelerations, StaticMargin, Statics, must_stay
from wholearm_jax.model import Phase, Scene
from wholearm_jax.phases import HandOver, TracedPhase, statics_at_start

EDGE_DIRECTIONS = 16  # in which a place on the edge of the polygon is looked for
EDGE_FRACTIONS = (0.0, 0.2, 0.4, 0.6, 0.8)  # of the way from its middle to there, at which a torque is tried

Balance = tuple[Statics, RestAccelerations]


class StrongHold(NamedTuple):
    """A torque that holds an object at rest."""

    static: StaticMargin
    is_strong: bool  # whether the object must stay


def strong_hold(scene: Scene, phase: Phase, traced: TracedPhase, hand_over: HandOver | None) -> StrongHold:
    """Return a torque that holds the object at a phase's start, by either contact of a hand-over.

    It is one under which the object must stay, or that with the largest margin if there is none.
    """
    if hand_over is None:
        balances: list[Balance] = [statics_at_start(scene, phase, traced)]
        best = balances[0][0].most_central_torque(balances[0][1])
    else:
        balances = [(one.statics, one.accelerations) for one in hand_over]
        best = hand_over.best_hold()
    if not best.margin > 0 or _must_stay(balances, best.torque[None]).all():
        return StrongHold(best, is_strong=best.margin > 0)
    strong = _farthest_from_others(balances)
    return StrongHold(strong or best, is_strong=strong is not None)


def _must_stay(balances: Sequence[Balance], torques: Float[np.ndarray, "torques 2"]) -> Bool[np.ndarray, "torques"]:
    return np.all([must_stay(statics, torques) for statics, _ in balances], axis=0)


def _farthest_from_others(balances: Sequence[Balance]) -> StaticMargin | None:
    """Of the torques under which an object must stay, return that which is farthest from all others."""
    edge = np.array(_edge_of_holds(balances))
    if not len(edge):
        return None
    middle, limit = edge.mean(0), balances[0][0].torque_limit
    tried = np.concatenate([middle + fraction * (edge - middle) for fraction in EDGE_FRACTIONS])
    strong = _must_stay(balances, tried * limit)
    if not strong.any():
        return None
    others = np.concatenate([edge, tried[~strong]])
    depth = np.linalg.norm(tried[strong][:, None] - others, axis=2).min(1)
    torque = limit * tried[strong][np.argmax(depth)]
    return min((statics.margin_under(torque) for statics, _ in balances), key=lambda one: one.margin)


def _edge_of_holds(balances: Sequence[Balance]) -> list[Float[np.ndarray, "2"]]:
    """Return the torques, over their limits, that hold the object and lie farthest out in each direction."""
    angles = np.linspace(0, 2 * np.pi, EDGE_DIRECTIONS, endpoint=False)
    found = [_farthest_hold(balances, np.array([np.cos(angle), np.sin(angle)])) for angle in angles]
    return [torque for torque in found if torque is not None]


def _farthest_hold(balances: Sequence[Balance], direction: Float[np.ndarray, "2"]) -> Float[np.ndarray, "2"] | None:
    limit, programme = balances[0][0].torque_limit, LinearProgramme()
    programme.add_variables("torque", -np.ones(2), np.ones(2))
    programme.add_variables("level", 0.0, 0.0)  # of all forces, at least
    programme.add_variables("reach", -np.inf, np.inf)
    programme.equal("reach", [0.0], torque=direction[None], reach=-1.0)
    for number, (statics, accelerations) in enumerate(balances):
        statics.add_forces(programme, level="level", torque_unit=limit, prefix=f"{number}_")
        rows = accelerations.rest_rows(limit)
        programme.at_most(f"{number}_rest", -rows[:, 0] - MIN_REST_MARGIN, torque=rows[:, 1:])
    found = programme.maximise("reach")
    return None if found is None else found.values["torque"]
