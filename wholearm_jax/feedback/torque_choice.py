r"""Choose the feed-forward torques and the gains together, for a whole set of objects.

At one place, with the motion's `(v, a)`, the torques that give the nominal object this motion are a line, `tau(x)`. For
any other object of the set the feedback has to correct, `tau + g alpha` with `alpha` such that it moves alike. Both the
place `x` on the line and the direction of `g` (with `A_tau g = 1`) are chosen for the largest least slack of forces,
over all objects: by search on a grid, once more on a finer one about the best.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from wholearm_jax.feedback.path_table import PathTerms

LINE, DIRECTIONS, ZOOMS = 41, 17, 3  # places on the line, directions of the gain, searches
WIDEST = 1.2  # largest angle between the gain and the direction that accelerates most [rad]
TORQUE_COST, CORRECTION_COST = 0.02, 1.0  # margin [N] that a torque, and a correction, of 1 N m in all may cost
LEAST_ANSWER = 0.2  # acceleration of the object that answers least to a correction, over the nominal one's
RIPPLE = 5.0  # correction that measured angles cause by being rounded [rad/s^2]


class TorqueChoice(NamedTuple):
    """The choice at each place."""

    torque: Float[np.ndarray, "places 2"]  # [N m]
    gain: Float[np.ndarray, "places 2"]  # [N m s^2]
    margin: Float[np.ndarray, "places"]  # least slack of all objects [N]; -inf: not all can follow within limits


def choose_torques(every: list[PathTerms], limit: Float[np.ndarray, "2"], v, a, gains=None) -> TorqueChoice:
    """Choose the torques at places, for the objects `every` (the nominal one first), within a `limit` [N m].

    `gains` fixes the gains.
    """
    found = [
        _choose(
            np.stack([terms.acceleration[k] for terms in every]),
            np.stack([terms.slack[k] for terms in every]),
            limit,
            np.array([1.0, v[k] ** 2, v[k]]),
            a[k],
            None if gains is None else gains[k],
        )
        for k in range(len(v))
    ]
    return TorqueChoice(*(np.array(rows) for rows in zip(*found, strict=True)))


def _choose(acceleration, slack, limit, speeds, a: float, gain):
    """Choose at one place: `acceleration` (objects, 5), `slack` (objects, facets, 5)."""
    pull = acceleration[0, 3:]
    size = np.hypot(*pull)
    ahead = pull / size
    across = np.array([-ahead[1], ahead[0]])
    base = ahead * (a - acceleration[0, :3] @ speeds) / size
    x, turn, best = 0.0, 0.0, None
    reach, spread = 2 * limit.max(), WIDEST
    for _ in range(ZOOMS):
        xs = x + reach * np.linspace(-1.0, 1.0, LINE)
        turns = np.clip(turn + spread * np.linspace(-1.0, 1.0, DIRECTIONS), -WIDEST, WIDEST)
        if gain is None:
            g = (np.cos(turns)[:, None] * ahead + np.sin(turns)[:, None] * across) / (size * np.cos(turns)[:, None])
        else:
            turns, g = np.zeros(1), gain[None]
        torque = base + xs[:, None] * across
        score, margin = _worst(acceleration, slack, limit, speeds, a, torque, g)
        i, j = np.unravel_index(np.argmax(score), score.shape)
        best = torque[i], g[j], margin[i, j]
        x, turn = xs[i], turns[j]
        reach, spread = 2 * reach / (LINE - 1), 2 * spread / (DIRECTIONS - 1)
    return best


def _worst(acceleration, slack, limit, speeds, a: float, torque, g):
    """Score and least slack over all objects, for torques (x, 2) and gains (turns, 2)."""
    missing = a - (acceleration[:, :3] @ speeds)[:, None] - acceleration[:, 3:] @ torque.T  # objects, x
    answer = acceleration[:, 3:] @ g.T  # objects, turns
    opposed = answer.min(0) < LEAST_ANSWER
    alpha = missing[:, :, None] / np.where(opposed, 1.0, answer)[:, None, :]  # objects, x, turns
    corrected = torque[None, :, None, :] + alpha[..., None] * g[None, None]
    free = (slack[:, :, :3] @ speeds)[:, None, None, :]
    forces = free + np.einsum("oft,oxgt->oxgf", slack[:, :, 3:], corrected)
    margin = forces.min((0, 3))
    over = np.maximum(np.abs(corrected) - limit, 0.0).max((0, 3)) + np.where(opposed, np.inf, 0.0)
    cost = TORQUE_COST * np.hypot(*torque.T)[:, None] + CORRECTION_COST * (RIPPLE + np.abs(alpha).max(0)) * np.hypot(
        *g.T
    )
    return np.where(over > 0, -1e3 * (1 + over), margin) - cost, np.where(over > 0, -np.inf, margin)
