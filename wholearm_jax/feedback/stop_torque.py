"""The push with which a phase ends against a new contact: enough for every object to arrive, little enough to stay."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from wholearm_jax.feedback.path_table import path_terms, tabulate_path
from wholearm_jax.margin import Statics, contact_statics
from wholearm_jax.model import AWAY_NAMES, Phase, Scene, object_radius
from wholearm_jax.phases import END_POSITION, TracedPhase, formation_at_end

LARGEST, TRIED = 60.0, 61  # pushes that are tried [rad/s^2]
TURNS = np.linspace(-1.2, 1.2, 7)  # their directions against that which accelerates most [rad]
STEEP_TURNS = np.array([-1.5, -1.4, -1.3, 1.3, 1.4, 1.5])  # further ones, which mostly squeeze, if the others fail
DECISIVE = 5.0  # least acceleration of the object that is hardest to move, before it stops [rad/s^2]
FALL = 200.0  # gravity over the radius of objects for which these, and all speeds at stops, are meant [rad/s^2]


class StopStatics(NamedTuple):
    """An object at its stop: the statics of the contacts that are closed there, and how it moved just before."""

    statics: Statics
    acceleration: Float[np.ndarray, "5"]  # of `PathTerms`, at the path's end
    tangent: Float[np.ndarray, "2"]  # of the curve of joint angles there
    radius: float  # of the object [m]
    slowness: float  # as `slowness` has it

    def pressed_over(self, torque: Float[np.ndarray, "2"], speed: float, *, either_finger: bool = True) -> float:
        """Return by how much a torque does not hold the object at its stop [N], as a negative number; else infinity.

        It is the margin at rest where that is negative, as the torque tips the object, or what a contact of a finger
        lacks where the finger comes to rest away from it, met at a `speed` [rad/s] along the path.
        """
        least = self.statics.margin_under(torque).margin
        if either_finger:
            stays_away = self.distances_away(torque, speed) > END_POSITION
            least = min(least, float(np.where(stays_away, self.surplus(torque), np.inf).min()))
        return least if least < 0 else np.inf

    def surplus(self, torque: Float[np.ndarray, "*torques 2"]) -> Float[np.ndarray, "*torques 2"]:
        """Return the force [N] at each contact of each finger that a torque has beyond the finger's dry friction.

        Where the object stops a finger goes on that moves away from it, and comes back only if this is positive. In
        `Statics` dry friction helps to hold a contact; a finger that stands away from the object it holds there.
        """
        touches = self._on_joint != 0
        force = self._presses(torque) - self.statics.dry
        return np.where(touches, force * self.statics.unit / np.where(touches, np.abs(self._on_joint), 1.0), np.inf)

    def distances_away(self, torque: Float[np.ndarray, "2"], speed: float) -> Float[np.ndarray, "2"]:
        """Return how far from the object each finger comes to rest that goes on where the object stops [m].

        Dry friction and the torque brake it; what viscous friction adds is left out.
        """
        statics, leaves = self.statics, np.maximum(np.sign(self._on_joint) * self.tangent * speed, 0.0)
        brake = statics.dry + self._presses(torque)
        angle = np.where(brake > 0, statics.mass[3:] * leaves**2 / (2 * np.where(brake > 0, brake, 1.0)), np.inf)
        angle = np.where((leaves > 0) & (self.surplus(torque) <= 0), angle, 0.0)  # else nothing leaves, or comes back
        return angle * np.abs(statics.wrench[3:, : len(statics.names)]).max(1) * self.radius

    def _presses(self, torque: Float[np.ndarray, "*torques 2"]) -> Float[np.ndarray, "*torques 2"]:
        """Return what a torque presses each finger toward the object with, in the unit of `Statics.dry`."""
        return -np.sign(self._on_joint) * (torque @ self.statics.load[3:, 1:].T)

    @property
    def _on_joint(self) -> Float[np.ndarray, "2"]:
        """What unit forces of all contacts do to the fingers."""
        return self.statics.wrench[3:, : len(self.statics.names)].sum(1)

    @property
    def decisive(self) -> float:
        """Least acceleration of the object that is hardest to move, before it stops [rad/s^2]."""
        return DECISIVE / self.slowness**2


def object_at_stop(scene: Scene, phase: Phase, path: TracedPhase) -> StopStatics:
    """Return an object at the end of its path of a phase. A finger that is away has no torque, whatever touches it."""
    closed, end = formation_at_end(scene, phase, path), np.asarray(path.end)
    table = tabulate_path(path.dynamics)
    terms = path_terms(path.dynamics, table)
    statics = contact_statics(scene, closed, end)
    limit = np.where([name in phase.formation.away for name in AWAY_NAMES], 0.0, statics.torque_limit)
    statics, radius = replace(statics, torque_limit=limit), object_radius(scene.object)
    return StopStatics(statics, terms.acceleration[-1], table.tangent[-1], radius, slowness(scene))


def slowness(scene: Scene) -> float:
    """Return how many times longer an object takes to fall over than one with gravity over radius as `FALL`.

    It is 1 for smaller ones. By so much longer times, and accelerations less by its square, large objects move as small
    ones do; at the small one's speeds and accelerations they would tip over their stops.
    """
    fall = float(np.hypot(*np.asarray(scene.gravity))) / object_radius(scene.object)
    return max(1.0, np.sqrt(FALL / fall)) if fall > 0 else 1.0


def stays_at_stop(stop: StopStatics) -> bool:
    """Return whether an object that is pushed against a stop can stay there.

    It cannot where every torque that moves it there moves it on, as where its edge comes to lie along the one finger
    that pushes it, or where it meets a finger that is away. Where the torque limits allow no such push it can.
    """
    margin = stop.statics.best_against(stop.acceleration[[0, 3, 4]], stop.decisive).margin
    return margin > 0 or margin == -np.inf


class _Push(NamedTuple):
    size: float  # [rad/s^2]
    direction: Float[np.ndarray, "2"]  # [N m s^2]
    margin: float  # at rest under it, the least of all objects [N]; NaN where no push is decisive


def choose_push(
    stops: list[StopStatics],
    torque: Float[np.ndarray, "2"],
    limit: Float[np.ndarray, "2"],
    *,
    either_finger: bool,
    bound: float = np.inf,
) -> tuple[float, Float[np.ndarray, "2"]]:
    """Choose the push with which objects arrive at a stop and stand there.

    Args:
        stops: The objects, the nominal one first.
        torque: The reference's last torque [N m].
        limit: The torque limits [N m].
        either_finger: Whether both fingers may push; else that alone which moves, as the other one is away or holds.
        bound: Largest torque that the feedback adds [N m].

    Returns:
        The acceleration [rad/s^2] that the feedback adds at most, and the torques for one of them [N m s^2]. Of all
        pushes within the limits and the bound with which every object is accelerated by `DECISIVE` (less where it is
        large: `slowness`), and of these where there are any that bring back fingers (`surplus`), it is that with the
        largest margin at rest (the least of all objects). Where that is negative, pushes that squeeze the object more
        are tried as well; where none accelerates so much, it is that which accelerates most.
    """
    limits = np.maximum(torque - bound, -limit), np.minimum(torque + bound, limit)
    push = _push_within(stops, torque, limits, TURNS if either_finger else np.zeros(1), returning=either_finger)
    if either_finger and push.margin <= 0:  # one that squeezes the object more may hold it
        steep = _push_within(stops, torque, limits, STEEP_TURNS, returning=True)
        push = max(push, steep, key=lambda one: one.margin)
    return push.size, push.direction


def _push_within(
    stops: list[StopStatics], torque, limits, turns: Float[np.ndarray, "turns"], *, returning: bool
) -> _Push:
    """Choose the best push of those whose directions have these angles against that which accelerates most.

    Those that bring back fingers are preferred where it has to be `returning`.
    """
    pull = stops[0].acceleration[3:]
    ahead, across = pull / np.hypot(*pull), np.array([-pull[1], pull[0]]) / np.hypot(*pull)
    directions = (ahead + np.tan(turns)[:, None] * across) / np.hypot(*pull)
    pushes = np.linspace(0.0, LARGEST, TRIED) / stops[0].slowness ** 2
    torques = (torque + pushes[:, None, None] * directions).reshape(-1, 2)
    moves = np.min([stop.acceleration[0] + torques @ stop.acceleration[3:] for stop in stops], axis=0)
    within = np.all((torques >= limits[0]) & (torques <= limits[1]), axis=1)
    decisive = within & (moves >= stops[0].decisive)
    if returning and (returns := decisive & (stops[0].surplus(torques) > 0).all(1)).any():
        decisive = returns
    candidates = np.flatnonzero(decisive)
    if len(candidates):
        best, margin = _largest_margin(stops, torques[candidates])
        chosen = int(candidates[best])
    else:
        chosen, margin = int(np.argmax(np.where(within, moves, -np.inf))), np.nan
    size, turn = divmod(chosen, len(turns))
    return _Push(float(pushes[size]), directions[turn], margin)


def _largest_margin(stops: list[StopStatics], torques: Float[np.ndarray, "torques 2"]) -> tuple[int, float]:
    """Return which torque has the largest margin at rest, the least of all objects, and that margin [N].

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
    return chosen, float(best)
