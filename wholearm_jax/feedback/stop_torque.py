"""The push with which a phase ends against a new contact: enough for every object to arrive, little enough to stay."""

import numpy as np
from jaxtyping import Float

from wholearm_jax.feedback.path_table import PathTerms
from wholearm_jax.margin import contact_statics
from wholearm_jax.model import ContactFormation, Scene

LARGEST, TRIED = 60.0, 31  # pushes that are tried [rad/s^2]
KEPT = 0.9  # fraction of the best margin at rest that a larger push may leave
ARRIVES = 1.0  # least acceleration with which every object still moves [rad/s^2]


def choose_push(
    scenes: list[Scene],
    closed: ContactFormation,
    z: Float[np.ndarray, "5"],
    every: list[PathTerms],
    torque: Float[np.ndarray, "2"],
    gain: Float[np.ndarray, "2"],
) -> float:
    """Choose the acceleration [rad/s^2] that the feedback adds at most once the path has ended.

    Args:
        scenes: The objects.
        closed: The formation with the contact that is made.
        z: Where it is made.
        every: The objects' equations of motion on the phase's path.
        torque: The reference's last torque [N m].
        gain: The gain at the path's end.

    Returns:
        The largest push that keeps `KEPT` of the best margin at rest (the least of all objects) of those with which all
        objects move within the torque limits; where there are none, that with which they move most.
    """
    pushes = np.linspace(0.0, LARGEST, TRIED)
    torques = torque + pushes[:, None] * gain
    moves = np.min([t.acceleration[-1, 0] + torques @ t.acceleration[-1, 3:] for t in every], axis=0)
    held = [contact_statics(scene, closed, z) for scene in scenes]
    margin = np.array([min(statics.margin_under(tau).margin for statics in held) for tau in torques])
    possible = (moves >= ARRIVES) & np.all(np.abs(torques) <= np.asarray(scenes[0].hand.torque_limit), axis=1)
    if not possible.any():
        return float(pushes[np.argmax(moves)])
    margin = np.where(possible, margin, -np.inf)
    firm = margin >= KEPT * margin.max() if margin.max() > 0 else margin == margin.max()
    return float(pushes[firm].max())
