r"""The law: torques from measured joint angles, sample after sample. NumPy alone.

At each sample the measured angles are projected onto the curve of the phase's joint angles; an observer of second
order, which expects the reference's acceleration, makes of that the place `s` and the speed `v`; and the torque is

    tau = tau_ref(t) + g(s) a,    a = w^2 (s_ref - s) + 2 w (v_ref - v) + i,    di/dt = k (a - 2 w (v_ref - v) - i)

with `t` since the phase began. `a` is cut where `|g a|` would exceed the controller's `push`: the integral part, which
else has the rate `k w^2 (s_ref - s)`, then goes to what the cut leaves instead of winding up (Astrom and Rundqwist,
Integrator windup and how to avoid it, ACC 1989, pp. 1693-1698), and its rate has no jump where the cut begins.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from wholearm_jax.feedback.controller import Controller, PhaseLaw

PROJECTIONS = 3  # Newton steps of the projection


class LawState(NamedTuple):
    """What the law remembers from sample to sample."""

    phase: int
    began: float  # when the phase began [s]
    time: float  # of the sample before [s]
    s: float  # place [rad]
    v: float  # speed [rad/s]
    offset: float  # place at the phase's start against the reference [rad]
    i: float  # integral part of the acceleration [rad/s^2]
    still: float  # time for which the object has not moved although it was pressed [s]
    pressed: bool  # whether the feedback pushes forward as far as it may
    arrived: bool  # whether the last phase has ended


def begin(controller: Controller, angles: Float[np.ndarray, "2"], time: float = 0.0) -> LawState:
    """Return the state at the plan's start."""
    s = project_on_path(controller.phases[0], angles, 0.0)
    return LawState(0, time, time, s, 0.0, s, 0.0, 0.0, False, False)


def step(
    controller: Controller, state: LawState, time: float, angles: Float[np.ndarray, "2"]
) -> tuple[LawState, Float[np.ndarray, "2"]]:
    """Take one sample: the next state, and the torques [N m] to hold until the next sample.

    Args:
        controller: The controller.
        state: State after the sample before.
        time: Time of the sample [s].
        angles: Measured joint angles [rad].
    """
    before, state = state.time, _observe(controller, state, time, angles)
    state = _change_phase(controller, state, time, angles)
    phase, h = controller.phases[state.phase], time - before
    since = time - state.began
    s_ref, v_ref, torque = reference(phase, since)
    s_ref += state.offset * max(0.0, 1.0 - since / phase.duration)
    # Act, within the bound of the feedback's torque.
    w = controller.stiffness
    (gain,) = _interpolate(phase.s, state.s, phase.gain)
    most = controller.push / max(abs(gain[0]), abs(gain[1]))
    ahead = min(most, phase.press) if s_ref > phase.length - phase.reach else most
    damping = 2 * w * (v_ref - state.v)
    uncut = w**2 * (s_ref - state.s) + damping + state.i
    a = min(max(uncut, -most), ahead)
    i = state.i + h * controller.integral * (a - damping - state.i)
    torque = np.clip(torque + gain * a, -controller.torque_limit, controller.torque_limit)
    return state._replace(time=time, i=i, pressed=bool(uncut >= ahead)), torque


def project_on_path(phase: PhaseLaw, angles, s: float) -> float:
    """Return the place [rad] on a phase's curve next to measured angles, from a place near it.

    Beyond its ends the curve goes on straight.
    """
    for _ in range(PROJECTIONS):
        inside = min(max(s, 0.0), phase.length)
        theta, tangent = _interpolate(phase.s, inside, phase.theta, phase.tangent)
        s = s + float(tangent @ (angles - theta - (s - inside) * tangent))
    return s


def reference(phase: PhaseLaw, since: float) -> tuple[float, float, Float[np.ndarray, "2"]]:
    """Return the reference's place and speed, and its torques, at a time since the phase began."""
    s_ref, v_ref, torque = _interpolate(phase.time, since, phase.s_ref, phase.v_ref, phase.torque)
    late = since - phase.duration
    if late > 0:
        v_ref = phase.approach if phase.approach * late < phase.reach else 0.0
        s_ref = s_ref + min(phase.approach * late, phase.reach)
    return float(s_ref), float(v_ref), torque


def _interpolate(nodes: Float[np.ndarray, "nodes"], at: float, *tables: Float[np.ndarray, "nodes ..."]) -> list:
    """Interpolate tables linearly; they are constant beyond their ends."""
    k = min(max(int(nodes.searchsorted(at, side="right")) - 1, 0), len(nodes) - 2)
    gap = nodes[k + 1] - nodes[k]
    share = min(max((at - nodes[k]) / gap, 0.0), 1.0) if gap > 0 else 1.0
    return [table[k] + share * (table[k + 1] - table[k]) for table in tables]


def _observe(controller: Controller, state: LawState, time: float, angles) -> LawState:
    """Observe place and speed: a filter of second order with the rate `observer`, critically damped.

    It expects the speed to change as the reference's does, so that an object that follows needs no correction.
    """
    phase, h = controller.phases[state.phase], time - state.time
    r = np.exp(-controller.observer * h)
    before, now = (_interpolate(phase.time, at - state.began, phase.v_ref)[0] for at in (state.time, time))
    faster = now - before
    predicted = state.s + h * (state.v + faster / 2)
    off = project_on_path(phase, angles, predicted) - predicted
    s, v = predicted + (1 - r**2) * off, state.v + faster + ((1 - r) ** 2 * off / h if h > 0 else 0.0)
    still = state.still + h if state.pressed and abs(v) < controller.felt[0] else 0.0
    return state._replace(s=float(s), v=float(v), still=still)


def _change_phase(controller: Controller, state: LawState, time: float, angles) -> LawState:
    """Go on to the next phase where this one has ended."""
    phase, since = controller.phases[state.phase], time - state.began
    late = since >= phase.duration + controller.patience
    stopped = since >= phase.duration and (phase.reach == 0 or (state.pressed and state.still >= controller.felt[1]))
    ended = late or (state.s >= phase.length if phase.flows else stopped)
    if not ended or state.arrived:
        return state
    if state.phase + 1 == len(controller.phases):
        return state._replace(arrived=True)
    following = controller.phases[state.phase + 1]
    s = project_on_path(following, angles, 0.0)
    turn = float(phase.tangent[-1] @ following.tangent[0])
    v = state.v * turn if phase.flows else 0.0
    return LawState(state.phase + 1, time, time, s, v, s - float(following.s_ref[0]), 0.0, 0.0, False, False)
