"""Initial guesses: motions with the torques that produce them, by the best internal force at every knot.

Derivation: section 8 of `docs/derivation.md`.
"""

import functools
import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from wholearm_jax.core import CachedJit, as_device_array
from wholearm_jax.dynamics import PathDynamics
from wholearm_jax.margin import best_quasistatic_torque_batch
from wholearm_jax.optimisation.constraints import impact_speed_ratio
from wholearm_jax.optimisation.variables import Variables

SPEED_PROFILES = tuple((p, q) for p in (1.0, 2.0, 4.0, 8.0, 16.0) for q in (1.0, 2.0, 4.0, 8.0, 16.0))
PROFILE_SUBSTEPS = 8  # steps of an interval in which a profile's speed is integrated
CUBIC_FRACTION = 0.3  # of a cubic motion in every profile, so that the object never quite stops on the way
TRANSITION_SPEEDS = (1.0, 0.4, 2.0)  # at changes of contact formation [path lengths a duration]
PROFILE_ADVANTAGE = 0.02  # relative gain in margin for which another profile than the first one comes first
MAX_ENTRY_SPEED = 2.9  # of a cubic motion that never goes back: less than 3 path lengths a duration

UnitMotion = tuple[np.ndarray, np.ndarray, np.ndarray]  # s, v, a at the knots, over unit length and time


def initial_guesses(
    phase_dynamics: list[PathDynamics],
    durations,
    knots: int,
    torque_fraction: float,
    convex: UnitMotion | None = None,
) -> list[Variables]:
    """Guess motions, with the torques that produce them.

    A single phase goes from rest to rest: as the convex optimum does, then with the profile of `SPEED_PROFILES` of the
    largest margin. Several go through their changes of contact formation at each of `TRANSITION_SPEEDS`.

    Args:
        phase_dynamics: path dynamics of each phase.
        durations: of each phase [s].
        knots: of each phase.
        torque_fraction: fraction of the torque limits that torques stay within.
        convex: motion of the convex optimum of a single phase (`convex_start`); None: only the profile.
    """
    if len(phase_dynamics) == 1:
        return _rest_to_rest_guesses(phase_dynamics[0], durations, knots, torque_fraction, convex)
    ratios = [float(_impact_speed_ratio(*pair)) for pair in itertools.pairwise(phase_dynamics)]
    guesses = []
    for speed in TRANSITION_SPEEDS:
        motions = _transition_motions(phase_dynamics, durations, knots, ratios, speed)
        phases = zip(phase_dynamics, durations, motions, strict=True)
        torques = [_quasistatic_torques(*phase[:2], [phase[2]], torque_fraction)[0][0] for phase in phases]
        guesses.append(_variables(torques, motions, durations))
    return guesses


def _rest_to_rest_guesses(
    dynamics: PathDynamics, durations, knots: int, torque_fraction: float, convex: UnitMotion | None
) -> list[Variables]:
    """Guess motions of a single phase."""
    profiles = _profile_motions(knots)
    motions = [*profiles, profiles[0] if convex is None else convex]  # always as many: one compiled program
    torque, margins = _quasistatic_torques(dynamics, durations[0], motions, torque_fraction)
    margins = margins[: len(profiles)]
    best = 0 if margins[0] >= margins.max() - PROFILE_ADVANTAGE * abs(margins.max()) else int(np.argmax(margins))
    order = [best] if convex is None else [len(profiles), best]
    return [_variables([torque[k]], [motions[k]], durations) for k in order]


def transformed_rest_to_rest_torques(dynamics: PathDynamics, duration, knots: int):
    """Return the torques `(knots, 2)` [N m] of the first guess of a single phase, usable in JAX's transformations."""
    s, v, a = (np.stack(rows) for rows in zip(*_profile_motions(knots), strict=True))
    length, first = dynamics.breakpoints[-1] - dynamics.breakpoints[0], dynamics.breakpoints[0]
    best = _best_torques(dynamics, first + length * s, length * v / duration, length * a / duration**2)
    margins = best.margin.min(1)
    largest = margins.max()
    is_first_enough = margins[0] >= largest - PROFILE_ADVANTAGE * jnp.abs(largest)
    chosen = jnp.where(is_first_enough, 0, jnp.argmax(margins))
    return jnp.clip(best.torque[chosen], -dynamics.torque_limit, dynamics.torque_limit)


def _transition_motions(phase_dynamics, durations, knots: int, ratios: list[float], speed: float) -> list[UnitMotion]:
    """Guess motions of phases that follow one another at speed, each of which ends at `speed` but the last."""
    entry, motions = 0.0, []
    for k, ratio in enumerate(ratios):
        motions.append(_cubic_motion(knots, entry, speed))
        entry = ratio * speed * float(phase_dynamics[k].length) / durations[k]
        entry = entry * durations[k + 1] / float(phase_dynamics[k + 1].length)
        entry = float(np.clip(entry, 0.0, MAX_ENTRY_SPEED))
    return [*motions, _cubic_motion(knots, entry, 0.0)]


def _quasistatic_torques(dynamics: PathDynamics, duration: float, motions: list[UnitMotion], torque_fraction: float):
    """Return the torques at the knots of each motion, over their limits, and its least force there [N]."""
    limit = np.asarray(dynamics.torque_limit)
    tightened = eqx.tree_at(lambda d: d.torque_limit, dynamics, as_device_array(torque_fraction * limit))
    breakpoints = np.asarray(dynamics.breakpoints)
    length, first = float(breakpoints[-1] - breakpoints[0]), float(breakpoints[0])
    s, v, a = (np.stack(rows) for rows in zip(*motions, strict=True))
    best = _best_torques(tightened, first + length * s, length * v / duration, length * a / duration**2)
    torque = np.clip(np.asarray(best.torque) / limit, -torque_fraction, torque_fraction)
    return torque, np.asarray(best.margin).min(1)


def _variables(torques, motions: list[UnitMotion], durations) -> Variables:
    state = np.stack([np.stack(motion[:2], axis=1) for motion in motions])
    state[:, 0, 0], state[:, -1, 0], state[-1, -1, 1] = 0.0, 1.0, 0.0
    return Variables(as_device_array(np.stack(torques)), as_device_array(state), as_device_array(np.log(durations)))


def _cubic_motion(knots: int, entry: float, leave: float) -> UnitMotion:
    """Return the cubic motion with given speeds at its ends."""
    u = np.linspace(0.0, 1.0, knots)
    s = np.polynomial.Polynomial([0.0, entry, 3 - 2 * entry - leave, entry + leave - 2])
    return s(u), s.deriv(1)(u), s.deriv(2)(u)


@functools.cache
def _profile_motions(knots: int) -> list[UnitMotion]:
    """Return the motions of all `SPEED_PROFILES`, which are the same for every plan."""
    return [_profile_motion(knots, *powers) for powers in SPEED_PROFILES]


def _profile_motion(knots: int, p: float, q: float) -> UnitMotion:
    """Return a motion from rest to rest: a cubic one and, for the larger part, one with speed `v ~ u^p (1 - u)^q`."""
    u = np.linspace(0.0, 1.0, PROFILE_SUBSTEPS * (knots - 1) + 1)
    inner = np.clip(u, 1e-12, 1 - 1e-12)
    v = inner**p * (1 - inner) ** q
    a = v * (p / inner - q / (1 - inner))
    s = np.concatenate([[0.0], np.cumsum((v[1:] + v[:-1]) / 2 * np.diff(u))])
    scale = (1 - CUBIC_FRACTION) / s[-1]
    motion = (
        scale * s + CUBIC_FRACTION * (3 * u**2 - 2 * u**3),
        scale * v + CUBIC_FRACTION * 6 * (u - u**2),
        scale * a + CUBIC_FRACTION * (6 - 12 * u),
    )
    s, v, a = (row[::PROFILE_SUBSTEPS] for row in motion)
    return s, v, a


_best_torques = CachedJit(jax.vmap(best_quasistatic_torque_batch, (None, 0, 0, 0)))


@jax.jit
def _impact_speed_ratio(before, after):
    return impact_speed_ratio(*(jax.tree.map(lambda a: a[None], dynamics) for dynamics in (before, after)))[0]
