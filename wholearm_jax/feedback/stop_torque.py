"""The push with which a phase ends against a new contact: enough for every object to arrive, little enough to stay."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from wholearm_jax.feedback.path_table import path_terms, tabulate_path
from wholearm_jax.margin import Statics, contact_statics
from wholearm_jax.model import AWAY_NAMES, Phase, Scene
from wholearm_jax.phases import TracedPhase, formation_at_end

LARGEST, TRIED = 60.0, 61  # pushes that are tried [rad/s^2]
TURNS = np.linspace(-1.2, 1.2, 7)  # their directions against that which accelerates most [rad]
DECISIVE = 5.0  # least acceleration of the object that is hardest to move, before it stops [rad/s^2]


class StopStatics(NamedTuple):
    """An object at its stop: the statics of the contacts that are closed there, and how it moved just before."""

    statics: Statics
    acceleration: Float[np.ndarray, "5"]  # of `PathTerms`, at the path's end

    def pressed_over(self, torque: Float[np.ndarray, "2"]) -> float:
        """Return the margin [N] at rest under a torque where that is negative, as it tips the object; else infinity."""
        margin = self.statics.margin_under(torque).margin
        return margin if margin < 0 else np.inf


def object_at_stop(scene: Scene, phase: Phase, path: TracedPhase) -> StopStatics:
    """Return an object at the end of its path of a phase. A finger that is away has no torque, whatever touches it."""
    closed, end = formation_at_end(scene, phase, path), np.asarray(path.end)
    terms = path_terms(path.dynamics, tabulate_path(path.dynamics))
    statics = contact_statics(scene, closed, end)
    limit = np.where([name in phase.formation.away for name in AWAY_NAMES], 0.0, statics.torque_limit)
    return StopStatics(replace(statics, torque_limit=limit), terms.acceleration[-1])


def stays_at_stop(stop: StopStatics) -> bool:
    """Return whether an object that is pushed against a stop can stay there.

    It cannot where every torque that moves it there moves it on, as where its edge comes to lie along the one finger
    that pushes it, or where it meets a finger that is away. Where the torque limits allow no such push it can.
    """
    margin = stop.statics.best_against(stop.acceleration[[0, 3, 4]], DECISIVE).margin
    return margin > 0 or margin == -np.inf


def choose_push(
    stops: list[StopStatics], torque: Float[np.ndarray, "2"], limit: Float[np.ndarray, "2"], *, either_finger: bool
) -> tuple[float, Float[np.ndarray, "2"]]:
    """Choose the push with which objects arrive at a stop and stand there.

    Args:
        stops: The objects, the nominal one first.
        torque: The reference's last torque [N m].
        limit: The torque limits [N m].
        either_finger: Whether both fingers may push; else that alone which moves, as the other one is away or holds.

    Returns:
        The acceleration [rad/s^2] that the feedback adds at most, and the torques for one of them [N m s^2]. Of all
        pushes within the torque limits with which every object is accelerated by `DECISIVE`, it is that with the
        largest margin at rest (the least of all objects); where there are none, that which accelerates most.
    """
    pull = stops[0].acceleration[3:]
    ahead, across = pull / np.hypot(*pull), np.array([-pull[1], pull[0]]) / np.hypot(*pull)
    turns = TURNS if either_finger else np.zeros(1)
    directions = (ahead + np.tan(turns)[:, None] * across) / np.hypot(*pull)
    pushes = np.linspace(0.0, LARGEST, TRIED)
    torques = (torque + pushes[:, None, None] * directions).reshape(-1, 2)
    moves = np.min([stop.acceleration[0] + torques @ stop.acceleration[3:] for stop in stops], axis=0)
    within = np.all(np.abs(torques) <= limit, axis=1)
    decisive = within & (moves >= DECISIVE)
    candidates = np.flatnonzero(decisive)
    if len(candidates):
        chosen = int(candidates[_largest_margin(stops, torques[candidates])])
    else:
        chosen = int(np.argmax(np.where(within, moves, -np.inf)))
    push, turn = divmod(chosen, len(turns))
    return float(pushes[push]), directions[turn]


def _largest_margin(stops: list[StopStatics], torques: Float[np.ndarray, "torques 2"]) -> int:
    """Return which torque has the largest margin at rest, the least of all objects.

    The nominal object's bounds it, so that few torques are asked of all objects, the one that ruled out the last first.
    """
    bounds = np.array([stops[0].statics.margin_under(torque).margin for torque in torques])
    others, chosen, best = [stop.statics for stop in stops[1:]], 0, -np.inf
    for k in np.argsort(-bounds, kind="stable"):
        if bounds[k] <= best:
            break
        margin = bounds[k]
        for j, statics in enumerate(others):
            margin = min(margin, statics.margin_under(torques[k]).margin)
            if margin <= best:
                others.insert(0, others.pop(j))
                break
        else:
            chosen, best = int(k), margin
    return chosen
