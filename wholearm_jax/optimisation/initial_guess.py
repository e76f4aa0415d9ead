"""Motions to start a descent from, with the torques that give them by the best squeeze at every knot.

Derivation: section 8 of `docs/derivation.md`.
"""

import functools
import itertools

import equinox as eqx
import jax
import numpy as np

from wholearm_jax.core import Program, as_device_array
from wholearm_jax.dynamics import PathDynamics
from wholearm_jax.margin import best_quasistatic_torque_batch
from wholearm_jax.optimisation.linearisation import impact_speed_ratio
from wholearm_jax.optimisation.multiple_shooting import Variables

SPEED_PROFILES = tuple((p, q) for p in (1.0, 2.0, 4.0, 8.0, 16.0) for q in (1.0, 2.0, 4.0, 8.0, 16.0))
FINE = 8  # steps a knot interval in which a profile's speed is summed
EVEN = 0.3  # share of the even motion in every profile, so that the object never quite stops on the way
SPEEDS = (1.0, 0.4, 2.0)  # speeds at changes of formation to start from [wire lengths a duration]
FALLBACK_PROFILES = (
    (16.0, 1.0),
    (1.0, 1.0),
    (1.0, 16.0),
)  # further starts: a long dwell first, none, a long dwell last


def initial_guesses(phase_dynamics: list[PathDynamics], durations, knots: int, share: float) -> list[Variables]:
    """Motions with the torques that give them, within a `share` of the limits, by the best squeeze.

    One phase goes from rest to rest: first that of `SPEED_PROFILES` with the largest margin (the even one unless
    another
    gains more than 2 %), then `FALLBACK_PROFILES`. Several go through their changes of formation at each of
    `BOUND_SPEEDS`.
    """
    if len(phase_dynamics) == 1:
        motions = _profiles(knots)
        torque, margins = _squeezed(phase_dynamics[0], durations[0], motions, share)
        best = 0 if margins[0] >= margins.max() - 0.02 * abs(margins.max()) else int(np.argmax(margins))
        order = [best, *(SPEED_PROFILES.index(other) for other in FALLBACK_PROFILES if SPEED_PROFILES[best] != other)]
        return [_variables([torque[k]], [motions[k]], durations) for k in order]
    ratios = [float(_passed_on(*pair)) for pair in itertools.pairwise(phase_dynamics)]
    found = []
    for speed in SPEEDS:
        entry, motions, torques = 0.0, [], []
        for k, (dynamics, length) in enumerate(zip(phase_dynamics, durations, strict=True)):
            leave = 0.0 if k == len(phase_dynamics) - 1 else speed
            motions.append(_cubic_motion(knots, entry, leave))
            torques.append(_squeezed(dynamics, length, motions[-1:], share)[0][0])
            if k < len(phase_dynamics) - 1:
                entry = ratios[k] * leave * float(dynamics.length) / length
                entry = float(np.clip(entry * durations[k + 1] / float(phase_dynamics[k + 1].length), 0.0, 2.9))
        found.append(_variables(torques, motions, durations))
    return found


def _squeezed(dynamics, time: float, motions, share: float):
    """Torques at the knots, in units of their limits, and the least forces [N] there, of motions over them."""
    full = np.asarray(dynamics.torque_limit)
    tight = eqx.tree_at(lambda t: t.torque_limit, dynamics, as_device_array(share * full))
    breakpoints = np.asarray(dynamics.breakpoints)
    length, first = float(breakpoints[-1] - breakpoints[0]), float(breakpoints[0])
    s, v, a = (np.stack(rows) for rows in zip(*motions, strict=True))
    held = _holds(tight, first + length * s, length * v / time, length * a / time**2)
    return np.clip(np.asarray(held.torque) / full, -share, share), np.asarray(held.margin).min(1)


def _variables(torques, motions, durations) -> Variables:
    state = np.stack([np.stack(motion[:2], axis=1) for motion in motions])
    state[:, 0, 0], state[:, -1, 0], state[-1, -1, 1] = 0.0, 1.0, 0.0
    return Variables(as_device_array(np.stack(torques)), as_device_array(state), as_device_array(np.log(durations)))


def _cubic_motion(knots: int, entry: float, leave: float):
    """Motion over a unit length and time with given speeds at its ends: a cubic."""
    u = np.linspace(0.0, 1.0, knots)
    s = np.polynomial.Polynomial([0.0, entry, 3 - 2 * entry - leave, entry + leave - 2])
    return s(u), s.deriv(1)(u), s.deriv(2)(u)


@functools.cache
def _profiles(knots: int):
    """All of `SPEED_PROFILES`, which are the same for every plan."""
    return [_profile(knots, *powers) for powers in SPEED_PROFILES]


def _profile(knots: int, p: float, q: float):
    """Motion over a unit length and time from rest to rest, `EVEN` even and the rest with speed `v ~ u^p (1 - u)^q`."""
    u = np.linspace(0.0, 1.0, FINE * (knots - 1) + 1)
    inner = np.clip(u, 1e-12, 1 - 1e-12)
    v = inner**p * (1 - inner) ** q
    a = v * (p / inner - q / (1 - inner))
    s = np.concatenate([[0.0], np.cumsum((v[1:] + v[:-1]) / 2 * np.diff(u))])
    scale = (1 - EVEN) / s[-1]
    motion = (
        scale * s + EVEN * (3 * u**2 - 2 * u**3),
        scale * v + EVEN * 6 * (u - u**2),
        scale * a + EVEN * (6 - 12 * u),
    )
    return tuple(row[::FINE] for row in motion)


_holds = Program(jax.vmap(best_quasistatic_torque_batch, (None, 0, 0, 0)))


@jax.jit
def _passed_on(before, after):
    return impact_speed_ratio(*(jax.tree.map(lambda a: a[None], dynamics) for dynamics in (before, after)))[0]
