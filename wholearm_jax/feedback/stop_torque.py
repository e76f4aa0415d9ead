"""The push with which a phase ends against a new contact: enough for every object to arrive, little enough to stay."""

import numpy as np
from jaxtyping import Float

from wholearm_jax.feedback.path_table import PathTerms
from wholearm_jax.margin import contact_statics
from wholearm_jax.model import ContactFormation, Scene

LARGEST, TRIED = 60.0, 13  # pushes that are tried [rad/s^2]
TURNS = np.linspace(-1.2, 1.2, 7)  # their directions against that which accelerates most [rad]
DECISIVE = 10.0  # least acceleration of the object that is hardest to move, before it stops [rad/s^2]


def choose_push(
    scenes: list[Scene],
    closed: ContactFormation,
    z: Float[np.ndarray, "5"],
    every: list[PathTerms],
    torque: Float[np.ndarray, "2"],
) -> tuple[float, Float[np.ndarray, "2"]]:
    """Choose the push with which objects arrive at a stop and stand there.

    Args:
        scenes: The objects.
        closed: The formation with the contact that is made.
        z: Where it is made.
        every: The objects' equations of motion on the phase's path.
        torque: The reference's last torque [N m].

    Returns:
        The acceleration [rad/s^2] that the feedback adds at most, and the torques for one of them [N m s^2]. Of all
        pushes within the torque limits with which every object is accelerated by `DECISIVE`, it is that with the
        largest margin at rest (the least of all objects); where there are none, that which accelerates most.
    """
    pull = every[0].acceleration[-1, 3:]
    ahead, across = pull / np.hypot(*pull), np.array([-pull[1], pull[0]]) / np.hypot(*pull)
    directions = (ahead + np.tan(TURNS)[:, None] * across) / np.hypot(*pull)
    pushes = np.linspace(0.0, LARGEST, TRIED)
    torques = (torque + pushes[:, None, None] * directions).reshape(-1, 2)
    moves = np.min([t.acceleration[-1, 0] + torques @ t.acceleration[-1, 3:] for t in every], axis=0)
    held = [contact_statics(scene, closed, z) for scene in scenes]
    within = np.all(np.abs(torques) <= np.asarray(scenes[0].hand.torque_limit), axis=1)
    margin = np.full(len(torques), -np.inf)
    for k in np.flatnonzero(within & (moves >= DECISIVE)):
        margin[k] = min(statics.margin_under(torques[k]).margin for statics in held)
    decisive = within & (moves >= DECISIVE)
    chosen = int(np.argmax(np.where(decisive, margin, -np.inf) if decisive.any() else np.where(within, moves, -np.inf)))
    push, turn = divmod(chosen, len(TURNS))
    return float(pushes[push]), directions[turn]
