"""Robust: the torque schedule whose margin is the largest over a sample of scenes, not over one.

The wires of the sampled scenes do not depend on torque: they are traced once. The schedule climbs from that which is
best for the nominal scene, by gradient ascent on the smooth minimum (`forces.log_barrier_minimum`) of all margins, less a
penalty for where the motions end. What counts is honest: the share of the samples that hold, then the margin at a low
quantile; the best schedule met on the way is kept, the nominal one among them.

Driven open loop, samples with other friction cannot all arrive exactly. A sample *holds* when every contact stays in
compression while each phase lasts and the phase ends within a share `arrival` of its wire's length of the end, at a
speed that fits (`assessment`); the next phase then starts at rest at the end, as in every plan.

Derivation: section 11 of `docs/derivation.md`.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float

from wholearm_jax.core import Program, Status, require_positive
from wholearm_jax.ensembles.ensemble import Ensemble
from wholearm_jax.margin import log_barrier_minimum
from wholearm_jax.model import Scene, TorqueSchedule, limit_violations, pad_schedule, rigid_body, scaled_mechanics
from wholearm_jax.optimisation import optimise
from wholearm_jax.phases import (
    ARRIVAL_SPEED_FACTOR,
    SimulatedPhase,
    TracedPhase,
    certify_rest,
    has_torque_jumps,
    require_covered,
    require_motion,
    simulate,
    simulate_phases,
    trace,
    with_plan_step_capacity,
)
from wholearm_jax.simulation import IntegratorOptions
from wholearm_jax.tracing import Resolution

COARSE = Resolution(6, 24, 8)
HOW = IntegratorOptions(tolerance=1e-7, max_steps=128, max_stages=6, adjoint="reverse")
WITHIN = 0.5  # share of the tolerance of arrival that the climb leaves as it is
NONE = -10.0  # margin [N] of a phase without any motion
TEMPERATURE = 0.02  # of the smooth minimum, as a share of the nominal margin


@dataclass(frozen=True)
class SampleScore:
    """How a schedule does on scenes: the share that holds, and the margin [N] at the quantile asked for."""

    success_rate: float
    margin: float


@dataclass(frozen=True)
class RobustSchedule:
    """A robust schedule beside the `nominal` one; `in_sample` and `out_of_sample` are (nominal, robust) on the sampled scenes and
    on as many others."""

    torque: TorqueSchedule
    nominal: TorqueSchedule
    in_sample: tuple[SampleScore, SampleScore]
    out_of_sample: tuple[SampleScore, SampleScore]


def optimise_robustly(
    ensemble: Ensemble,
    *,
    samples: int = 64,
    quantile: float = 0.0,
    knots: int = 51,
    steps: int = 60,
    arrival: float = 0.01,
    rate: float = 2e-3,
    nominal: TorqueSchedule | None = None,
    callback: Callable[[int, SampleScore], None] | None = None,
) -> RobustSchedule:
    """Maximise the margin at a low `quantile` (0: the worst) over the first `samples` scenes of an ensemble.

    `rate` is the step of Adam as a share of the torque limits. `nominal` starts from another schedule than
    `optimise(ensemble.scene)` finds. `callback` sees each step's number and how its schedule does on the samples.
    A sample that would hold, but whose object waits where nothing proves that friction can keep it there (`resting`),
    is simulated by itself.
    Raises ValueError for a plan that holds its object in a phase, for numbers that are not positive, and for a
    `nominal` schedule that is shorter than the plan or beyond the torque limits.
    """
    scene, limit = ensemble.scene, ensemble.scene.hand.torque_limit
    require_positive(samples=samples, knots=knots, steps=steps, arrival=arrival, rate=rate)
    require_motion(scene)
    start = optimise(scene, knots=knots).torque if nominal is None else nominal
    require_covered(scene, start)
    _require_within(limit, start)
    in_sample, out_of_sample = (_sampled(ensemble, jnp.arange(samples) + first) for first in (0, samples))
    options = replace(with_plan_step_capacity(HOW, scene, start), has_jumps=has_torque_jumps(scene, start))

    def tried(torque: TorqueSchedule, sampled: _Sampled) -> tuple[_Climbed, SampleScore]:
        found = _objective_and_gradient(torque, sampled, jnp.asarray(arrival, float), options)
        holds = np.array(found.holds)
        for k in np.flatnonzero(holds & ~np.asarray(found.proved)):
            alone = jax.tree.map(lambda leaf, k=k: leaf[k], sampled.scenes)
            holds[k] = simulate(alone, torque, arrival=arrival).status is Status.OK
        return found, SampleScore(float(holds.mean()), float(jnp.quantile(found.margins, quantile, method="lower")))

    adam = optax.adam(optax.cosine_decay_schedule(rate, steps, 0.05))
    share = start.values / limit
    state = adam.init(share)
    best, nominally, best_held = start, None, SampleScore(-1.0, -np.inf)
    for step in range(steps + 1):
        torque = TorqueSchedule(start.times, share * limit)
        found, now = tried(torque, in_sample)
        if callback is not None:
            callback(step, now)
        nominally = nominally or now
        if (now.success_rate, now.margin) > (best_held.success_rate, best_held.margin):
            best, best_held = torque, now
        moves, state = adam.update(-found.slope * limit, state)
        share = jnp.clip(jnp.asarray(optax.apply_updates(share, moves)), -1.0, 1.0)
    assert nominally is not None
    return RobustSchedule(
        best,
        start,
        in_sample=(nominally, best_held),
        out_of_sample=(tried(start, out_of_sample)[1], tried(best, out_of_sample)[1]),
    )


def _require_within(limits, torque: TorqueSchedule) -> None:
    """Raise ValueError for torques beyond their limits: the climb would keep them if they did best."""
    for finger, reached, _, limit in limit_violations(torque, limits):
        raise ValueError(f"the nominal torque of finger {finger} is {reached:g} N m, its limit {limit:g} N m")


class _Sampled(NamedTuple):
    """Scenes along a leading axis, and for each phase their wires."""

    scenes: Scene
    traced: tuple[TracedPhase, ...]


class _Climbed(NamedTuple):
    """Margins [N] of all samples, whether they hold, whether it is `proved` that friction can keep them wherever they
    rest, and the objective's derivative with respect to the torques."""

    margins: Float[Array, "samples"]
    holds: Bool[Array, "samples"]
    proved: Bool[Array, "samples"]
    slope: Float[Array, "rows 2"]


@Program
def _sampled(ensemble: Ensemble, numbers) -> _Sampled:
    """Some scenes, traced."""

    def one(number):
        scene = ensemble.draw(number)
        return _Sampled(scene, trace(scene, resolution=COARSE))

    return jax.lax.map(one, numbers, batch_size=32)


@Program
def _objective_and_gradient(torque: TorqueSchedule, sampled: _Sampled, arrival, options: IntegratorOptions) -> _Climbed:
    """How a schedule does on all samples, and which way it gets better."""

    def objective(values) -> tuple[Float[Array, ""], tuple]:
        def one(sample: _Sampled):
            scene, at = sample
            found = simulate_phases(scene, TorqueSchedule(torque.times, values), at, options, arrival)
            least = jnp.stack(
                [jnp.where(jnp.isfinite(o.margin_result.margin), o.margin_result.margin, NONE) for o in found]
            ).min()
            ends = zip(scene.phases, found, at, strict=True)
            missed = jnp.stack([_arrival_penalty(o, t.dynamics, p.arrive, arrival) for p, o, t in ends]).sum()
            holds = jnp.stack([o.assessment.status == int(Status.OK) for o in found]).all()
            moves = jnp.stack([jnp.isfinite(o.margin_result.margin) for o in found]).all()
            return least, missed, holds, moves, _rests_proved(sample, torque, found)

        margins, missed, holds, moves, proved = jax.vmap(one)(sampled)
        weights = jnp.full(margins.shape, 1.0 / margins.shape[0])
        scale = jnp.maximum(jnp.abs(jax.lax.stop_gradient(margins)).max(), 1e-3)
        low, _ = log_barrier_minimum(margins, weights, TEMPERATURE * scale)
        return low - scale * missed.mean(), (jnp.where(moves, margins, -jnp.inf), holds, proved)

    slope, (margins, holds, proved) = jax.grad(objective, has_aux=True)(torque.values)
    return _Climbed(margins, holds, proved, slope)


def _rests_proved(sample: _Sampled, torque: TorqueSchedule, found: tuple[SimulatedPhase, ...]) -> Bool[Array, ""]:
    """Whether it is proved that friction can keep the object wherever it rests."""
    scene, traced = sample
    fixed = jax.lax.stop_gradient(found)
    solid, rows = rigid_body(scene.object), zip(scene.phases, traced, fixed, strict=True)
    each = [(scaled_mechanics(solid, scene.hand, scene.gravity, p.formation), t.dynamics, o) for p, t, o in rows]
    return jnp.stack(
        [certify_rest(mechanics, dynamics, pad_schedule(torque), o) for mechanics, dynamics, o in each]
    ).all()


def _arrival_penalty(outcome, dynamics, arrive: str, arrival):
    """How far beyond the tolerance a phase ends from where it should: a logarithm, lest the worst sample rule all."""
    at = outcome.motion.count
    off = [jnp.abs(dynamics.breakpoints[-1] - outcome.motion.s[at]) / dynamics.length / arrival]
    if arrive == "rest":
        off.append(outcome.motion.w[at] / dynamics.length / jnp.sqrt(ARRIVAL_SPEED_FACTOR * arrival))
    return sum(jnp.log1p(jnp.maximum(one - WITHIN, 0.0) ** 2) for one in off)
