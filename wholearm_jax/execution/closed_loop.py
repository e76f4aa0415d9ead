r"""Close the loop: a controller that drives the free bodies through encoders and motors that are not ideal.

The controller sees joint angles alone, at its sampling rate and rounded to the encoders' counts. Its torques act
`delay` later and are held until the next ones, each in error by a share of itself drawn anew at every sample.
"""

from collections import deque
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from wholearm_jax.core import require_positive
from wholearm_jax.feedback import ENCODER_COUNTS, Controller, begin, require_same_plan
from wholearm_jax.feedback import step as law_step
from wholearm_jax.model import Scene
from wholearm_jax.phases import MOTOR_ERROR

SETTLING = 0.1  # time for which the controller holds the object after its arrival [s]


class Hardware(NamedTuple):
    """Sampling rate [Hz], delay from measurement to torque [s], encoder counts a turn (0: exact), torque noise.

    The noise is normal, its standard deviation a share of the torque.
    """

    rate: float = 1000.0
    delay: float = 1e-3
    counts: int = ENCODER_COUNTS
    torque_noise: float = MOTOR_ERROR


IDEAL = Hardware(delay=0.0, counts=0, torque_noise=0.0)
"""Exact and without delay, but sampled."""


def require_hardware(hardware: Hardware) -> None:
    """Raise ValueError for hardware that cannot be."""
    require_positive(rate=hardware.rate)
    if hardware.delay < 0 or hardware.counts < 0 or hardware.torque_noise < 0:
        raise ValueError("delay, counts, torque_noise: must not be negative")


def closed_loop_step(controller: Controller, hardware: Hardware, scene: Scene, timestep: float) -> float:
    """Return the time step [s] next to `timestep` of which the sampling period is a multiple.

    Raises ValueError for hardware that cannot be, and where the controller is for another plan.
    """
    require_hardware(hardware)
    require_same_plan(controller, scene)
    return 1 / hardware.rate / max(1, round(1 / hardware.rate / timestep))


class ControlledMotor:
    """The torque of every time step, asked for one after the other while the bodies move."""

    def __init__(self, controller: Controller, hardware: Hardware, timestep: float, seed: int):
        """Start with the torque of the reference's start."""
        self._controller, self._hardware, self._timestep = controller, hardware, timestep
        self._every = round(1 / hardware.rate / timestep)
        self._late = round(hardware.delay / timestep)
        self._random = np.random.default_rng(seed)
        self._state, self._torque = None, controller.phases[0].torque[0]
        self._pending: deque[tuple[int, np.ndarray]] = deque()
        self._end: int | None = None
        self.begins: list[float] = []  # when each phase that the controller has come to began [s]

    @property
    def phase(self) -> int:
        """The number of the phase that the controller is in."""
        return 0 if self._state is None else self._state.phase

    def __call__(self, k: int, angles: Float[np.ndarray, "2"]) -> Float[np.ndarray, "2"] | None:
        """Return the torque of time step `k`, before which the joints stand at `angles`; None once the plan is over."""
        if k % self._every == 0:
            self._sample(k, angles)
        if self._end is not None and k >= self._end:
            return None
        while self._pending and self._pending[0][0] <= k:
            self._torque = self._pending.popleft()[1]
        return self._torque

    def _sample(self, k: int, angles) -> None:
        """Measure, and put the controller's torque in line."""
        time, counts = k * self._timestep, self._hardware.counts
        measured = np.round(angles * counts / (2 * np.pi)) * (2 * np.pi) / counts if counts else np.array(angles)
        if self._state is None:
            self._state = begin(self._controller, measured, time)
        self._state, torque = law_step(self._controller, self._state, time, measured)
        if self._state.phase == len(self.begins):
            self.begins.append(self._state.began)
        noisy = torque * (1 + self._hardware.torque_noise * self._random.standard_normal(2))
        limit = self._controller.torque_limit
        self._pending.append((k + self._late, np.clip(noisy, -limit, limit)))
        if self._state.arrived and self._end is None:
            self._end = k + round(SETTLING / self._timestep)
