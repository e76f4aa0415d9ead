"""The impulses with which objects of a set pass from one phase to the next without a stop."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from wholearm_jax.dynamics import PathDynamics, evaluate, locate_panel, resolve_impact
from wholearm_jax.feedback.design import corner_scenes
from wholearm_jax.margin import force_slack
from wholearm_jax.model import Arrival, Scene
from wholearm_jax.phases import trace


class PassingImpulse(NamedTuple):
    """An impulse at the entry of a phase: the phase's number, the contact, and its share of the largest impulse.

    A negative share pulls: the contact opens for an instant, however slowly the object passes.
    """

    phase: int
    contact: str
    share: float


def least_passing_impulse(scene: Scene, friction: float, mass: float = 0.0) -> PassingImpulse | None:
    """Find the least impulse of those at which a set of objects passes from phase to phase.

    Its sign does not depend on the law: impulses grow alike with the speed.

    Args:
        scene: Scene with its plan.
        friction: Half width of each link's friction, relative; the objects are those at the ends of the ranges.
        mass: Half width of the mass, relative.

    Returns:
        The impulse; None where each phase ends with a stop.
    """
    passed = [k for k, phase in enumerate(scene.phases[:-1]) if phase.arrive is Arrival.MOVING]
    found = []
    for other in corner_scenes(scene, friction, mass) if passed else ():
        traced = trace(other)
        for k in passed:
            shares = np.asarray(_impulse_shares(traced[k].dynamics, traced[k + 1].dynamics))
            formation = scene.phases[k + 1].formation
            contact = formation.names[formation.contact_of_row[int(shares.argmin())]]
            found.append(PassingImpulse(k + 1, contact, float(shares.min())))
    return min(found, key=lambda one: one.share, default=None)


@jax.jit
def _impulse_shares(before: PathDynamics, after: PathDynamics):
    """Slacks of the impulses at which a path is entered from the end of the one before, over the largest impulse."""
    panel, xi = locate_panel(before, before.count - 1, before.breakpoints[before.count])
    impulse = resolve_impact(after, evaluate(before.velocity, panel, xi)).impulse
    return force_slack(after, impulse) / jnp.abs(impulse).max()
