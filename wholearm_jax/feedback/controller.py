"""A controller as data: tables along each phase's path, its reference in time, and a few constants.

The place on a path is measured by the joint angles alone: `s` is the length of the curve `(theta1, theta2)` in the
plane of the joint angles, in radians, from the phase's start.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True)
class PhaseLaw:
    """The law of one phase.

    Tables are linear between their rows.

    Attributes:
        name: The phase's.
        contacts: Its contact formation.
        flows: Whether the next phase continues the motion: this one ends where the place passes the path's end.
        s: Along the path: places [rad].
        theta: Joint angles there [rad].
        tangent: Unit tangent of their curve.
        gain: Torques that accelerate `s` by 1 rad/s^2 [N m s^2].
        time: Times since the phase began [s].
        s_ref: The reference's places [rad].
        v_ref: Its speeds [rad/s].
        torque: Torques of its motion [N m].
        reach: How far the reference goes on beyond the path's end, to meet the contact that ends the phase, or to
            pass the end if the phase flows [rad] (0: nothing stops the object there, and the phase ends by the clock).
        approach: Speed with which it does [rad/s].
        press: Largest acceleration [rad/s^2] that the feedback adds forward within `reach` of the end.
        margin: Least force [N] over the objects that the law was designed for, moving as the reference does and as
            they are simulated under the law.
    """

    name: str
    contacts: tuple[str, ...]
    flows: bool
    s: Float[np.ndarray, "nodes"]
    theta: Float[np.ndarray, "nodes 2"]
    tangent: Float[np.ndarray, "nodes 2"]
    gain: Float[np.ndarray, "nodes 2"]
    time: Float[np.ndarray, "times"]
    s_ref: Float[np.ndarray, "times"]
    v_ref: Float[np.ndarray, "times"]
    torque: Float[np.ndarray, "times 2"]
    reach: float
    approach: float
    press: float
    margin: float

    @property
    def duration(self) -> float:
        """How long the reference takes to the path's end [s]."""
        return float(self.time[-1])

    @property
    def length(self) -> float:
        """The path's length in joint angles [rad]."""
        return float(self.s[-1])


@dataclass(frozen=True)
class Controller:
    """A closed-loop law for a plan; `feedback.step` is the law, `docs/feedback.md` describes it.

    Attributes:
        title: the scene's.
        phases: the law of each phase.
        stiffness: `w` [1/s], the loop's natural frequency.
        integral: rate `k_i` [1/s] at which a lasting error raises the acceleration.
        observer: rate `w_o` [1/s] of the filter for place and speed.
        push: largest torque of the feedback [N m].
        felt: what counts as a stop: a speed [rad/s] below which, and the time [s] for which.
        patience: longest time [s] beyond a phase's duration.
        torque_limit: of both joints [N m].
    """

    title: str
    phases: tuple[PhaseLaw, ...]
    stiffness: float
    integral: float
    observer: float
    push: float
    felt: tuple[float, float]
    patience: float
    torque_limit: Float[np.ndarray, "2"]

    @property
    def margin(self) -> float:
        """The smallest margin of all phases [N]; negative: some object of the set cannot be held."""
        return min(phase.margin for phase in self.phases)

    @property
    def longest(self) -> float:
        """The longest time that the plan can take [s]."""
        return sum(phase.duration + self.patience for phase in self.phases)
