r"""Choose the feed-forward torques and the gains together, for a whole set of objects.

At one place, with the motion's `(v, a)`, the torques that give the nominal object this motion are a line, `tau(x)`. For
any other object of the set the feedback has to correct, `tau + g alpha` with `alpha` such that it moves alike. Both the
place `x` on the line and the direction of `g` (with `A_tau g = 1`) are chosen on a grid, once more on finer ones about
the best: first for the largest least slack of forces, over all objects and places, and then, by dynamic programming
from place to place, for the largest least slacks and torques that change little. Two ways to squeeze may be equally
good for a while; the torques go over from the one to the other by and by, as a motor can.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from wholearm_jax.feedback.path_table import PathTerms
from wholearm_jax.model import Scene, object_radius

LINE, DIRECTIONS, ZOOMS = 41, 17, 3  # places on the line, directions of the gain, searches
WIDEST = 1.2  # largest angle between the gain and the direction that accelerates most [rad]
TORQUE_COST, CORRECTION_COST = 0.02, 1.0  # margin [N] that a torque, and a correction, of 1 N m in all may cost
LEAST_ANSWER = 0.2  # acceleration of the object that answers least to a correction, over the nominal one's
RIPPLE = 5.0  # correction that measured angles cause by being rounded [rad/s^2]
TORQUE_STEP, TURN_STEP = 0.1, 0.5  # change from place to place [N m], [rad] that may cost 1 N of margin at one place
COSTED_WEIGHT, COSTED_MOMENT = 2.2, 0.1  # weight [N], and times the radius [N m], up to which these costs are meant
SHORT_COST = 1e3  # of a margin below the least that every place can have


class TorqueChoice(NamedTuple):
    """The choice at each place."""

    torque: Float[np.ndarray, "places 2"]  # [N m]
    gain: Float[np.ndarray, "places 2"]  # [N m s^2]
    margin: Float[np.ndarray, "places"]  # least slack of all objects [N]; -inf: not all can follow within limits


class CostUnits(NamedTuple):
    """By how many times larger forces and torques are than those for which the costs of the choice are meant."""

    force: float = 1.0
    torque: float = 1.0


def cost_units(scene: Scene) -> CostUnits:
    """Return the units of costs for a scene: forces grow with the object's weight, torques with its radius as well."""
    weight = float(scene.object.mass) * float(np.hypot(*np.asarray(scene.gravity)))
    moment = weight * object_radius(scene.object)
    return CostUnits(max(1.0, weight / COSTED_WEIGHT), max(1.0, moment / COSTED_MOMENT))


class _Place(NamedTuple):
    """What the choice at one place needs."""

    acceleration: Float[np.ndarray, "objects 5"]
    slack: Float[np.ndarray, "objects facets 5"]
    speeds: Float[np.ndarray, "3"]  # 1, v^2, v
    a: float  # acceleration to reach [rad/s^2]

    @property
    def axes(self):
        """Directions that accelerate the nominal object most and not at all, and the first one's effect."""
        pull = self.acceleration[0, 3:]
        size = np.hypot(*pull)
        ahead = pull / size
        return ahead, np.array([-ahead[1], ahead[0]]), size

    def torques(self, x: Float[np.ndarray, "x"]) -> Float[np.ndarray, "x 2"]:
        """Return torques that give the nominal object its motion, `x` [N m] along their line."""
        ahead, across, size = self.axes
        return ahead * (self.a - self.acceleration[0, :3] @ self.speeds) / size + x[:, None] * across

    def gains(self, turn: Float[np.ndarray, "turns"]) -> Float[np.ndarray, "turns 2"]:
        """Return gains in directions `turn` [rad] from the one that accelerates most."""
        ahead, across, size = self.axes
        return (ahead + np.tan(turn)[:, None] * across) / size


def choose_torques(
    every: list[PathTerms], limit: Float[np.ndarray, "2"], v, a, units: CostUnits = CostUnits()
) -> TorqueChoice:
    """Choose the torques at places, for the objects `every` (the nominal one first), within a `limit` [N m]."""
    acceleration = np.stack([terms.acceleration for terms in every], axis=1)
    slack = np.stack([terms.slack for terms in every], axis=1)
    speeds = np.stack([np.ones_like(v), v**2, v], axis=1)
    places = [_Place(*rows) for rows in zip(acceleration, slack, speeds, a, strict=True)]
    x, turn = np.zeros(len(places)), np.zeros(len(places))
    reach, spread = 2 * limit.max(), WIDEST
    for _ in range(ZOOMS):
        xs = x[:, None] + reach * np.linspace(-1.0, 1.0, LINE)
        turns = np.clip(turn[:, None] + spread * np.linspace(-1.0, 1.0, DIRECTIONS), -WIDEST, WIDEST)
        torque = np.stack([place.torques(row) for place, row in zip(places, xs, strict=True)])
        gain = np.stack([place.gains(row) for place, row in zip(places, turns, strict=True)])
        found = [_worst(*place, limit, *each, units) for place, *each in zip(places, torque, gain, strict=True)]
        score, margin = (np.stack(rows) for rows in zip(*found, strict=True))
        # A place that is better than the worst one may give some of it for a smooth course, but stays better.
        least = score.max((1, 2)).min()
        i, j = _smoothest(score - SHORT_COST * np.maximum(least - score, 0.0), torque, turns, units)
        each = np.arange(len(places))
        x, turn = xs[each, i], turns[each, j]
        reach, spread = 2 * reach / (LINE - 1), 2 * spread / (DIRECTIONS - 1)
    return TorqueChoice(torque[each, i], gain[each, j], margin[each, i, j])


def _worst(acceleration, slack, speeds, a: float, limit, torque, g, units: CostUnits):
    """Score and least slack over all objects at one place, for torques (x, 2) and gains (turns, 2)."""
    missing = a - (acceleration[:, :3] @ speeds)[:, None] - acceleration[:, 3:] @ torque.T  # objects, x
    answer = acceleration[:, 3:] @ g.T  # objects, turns
    opposed = answer.min(0) < LEAST_ANSWER
    alpha = missing[:, :, None] / np.where(opposed, 1.0, answer)[:, None, :]  # objects, x, turns
    # Forces and torques are affine in the correction; one facet, or motor, of all objects at a time stays in the cache.
    force = (slack[:, :, :3] @ speeds)[:, :, None] + slack[:, :, 3:] @ torque.T  # objects, facets, x
    force_rate = slack[:, :, 3:] @ g.T  # objects, facets, turns
    forces = [(force[:, k, :, None] + alpha * force_rate[:, k, None]).min(0) for k in range(slack.shape[1])]
    margin = np.min(forces, axis=0)
    excess = [np.abs(torque[:, k, None] + alpha * g[:, k]).max(0) - limit[k] for k in range(len(limit))]
    over = np.maximum(np.max(excess, axis=0), 0.0) + np.where(opposed, 1e3, 0.0)
    cost = TORQUE_COST * np.hypot(*torque.T)[:, None] + CORRECTION_COST * (RIPPLE + np.abs(alpha).max(0)) * np.hypot(
        *g.T
    )
    cost *= units.force / units.torque
    return np.where(over > 0, -1e3 * units.force * (1 + over), margin) - cost, np.where(over > 0, -np.inf, margin)


def _smoothest(score, torque, turn, units: CostUnits):
    """Choose `x` and `turn` at each place for the largest sum of scores (places, x, turns) less the cost of change."""
    score = score / units.force
    best, came_from = score[0], []
    for k in range(1, len(score)):
        # The best turn before for each turn, and then the best `x` before for each: the costs are apart.
        change = ((turn[k - 1][:, None] - turn[k]) / TURN_STEP) ** 2
        options = best[:, :, None] - change
        turn_before, reached = options.argmax(1), options.max(1)
        change = (((torque[k - 1][:, None] - torque[k]) / (TORQUE_STEP * units.torque)) ** 2).sum(2)
        options = reached[:, None, :] - change[:, :, None]
        x_before = options.argmax(0)
        came_from.append((x_before, np.take_along_axis(turn_before, x_before, axis=0)))
        best = score[k] + options.max(0)
    i, j = (int(n) for n in np.unravel_index(best.argmax(), best.shape))
    course = [(i, j)]
    for x_before, turn_before in reversed(came_from):
        i, j = int(x_before[i, j]), int(turn_before[i, j])
        course.append((i, j))
    return np.array(course[::-1]).T
