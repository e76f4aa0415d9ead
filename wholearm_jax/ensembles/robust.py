"""Robust: the torque schedule whose margin is the largest over a sample of scenes, not over one.

The wires of the sampled scenes do not depend on torque: they are traced once. The schedule climbs from that which is
best for the nominal scene, by gradient ascent on the smooth minimum (`forces.log_barrier_minimum`) of all margins, less a
penalty for where the motions end. What counts is honest: the share of the samples that hold, then the margin at a low
quantile; the best schedule met on the way is kept, the nominal one among them.

Driven open loop, samples with other friction cannot all arrive exactly. A sample *holds* when every contact stays in
compression while each phase lasts and the phase ends within a share `arrival` of its wire's length of the end, at a
speed that fits (`verdict`); the next phase then starts at rest at the end, as in every plan.

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

from wholearm_jax.core.programs import Program
from wholearm_jax.core.status import Status
from wholearm_jax.core.validation import require_positive
from wholearm_jax.ensembles.ensemble import Ensemble
from wholearm_jax.margin.contact_forces import log_barrier_minimum
from wholearm_jax.model.mechanics import scaled_mechanics
from wholearm_jax.model.scene import Scene, rigid_body
from wholearm_jax.model.schedule import TorqueSchedule, limit_violations, pad_schedule
from wholearm_jax.optimisation.optimiser import optimise
from wholearm_jax.phases.assessment import ARRIVAL_SPEED_FACTOR
from wholearm_jax.phases.phase import SimulatedPhase, TracedPhase
from wholearm_jax.phases.plan import simulate_phases, require_covered, require_motion, with_plan_step_capacity, simulate, has_torque_jumps, trace
from wholearm_jax.phases.rest_certificate import certify_rest
from wholearm_jax.simulation.integrator import IntegratorOptions
from wholearm_jax.tracing.path import Resolution

COARSE = Resolution(6, 24, 8)
HOW = IntegratorOptions(tolerance=1e-7, max_steps=128, stages=6, adjoint="reverse")
WITHIN = 0.5  # share of the tolerance of arrival that the climb leaves as it is
NONE = -10.0  # margin [N] of a phase without any motion
TEMPERATURE = 0.02  # of the smooth minimum, as a share of the nominal margin


@dataclass(frozen=True)
class SampleScore:
    """How a schedule does on scenes: the share that holds, and the margin [N] at the quantile asked for."""

    share: float
    margin: float


@dataclass(frozen=True)
class RobustSchedule:
    """A robust schedule beside the `nominal` one; `seen` and `unseen` are (nominal, robust) on the sampled scenes and
    on as many others."""

    torque: TorqueSchedule
    nominal: TorqueSchedule
    seen: tuple[SampleScore, SampleScore]
    unseen: tuple[SampleScore, SampleScore]


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
    seen, unseen = (_sampled(ensemble, jnp.arange(samples) + first) for first in (0, samples))
    how = replace(with_plan_step_capacity(HOW, scene, start), steps=has_torque_jumps(scene, start))

    def tried(torque: TorqueSchedule, sampled: _Sampled) -> tuple[_Climbed, SampleScore]:
        found = _objective_and_gradient(torque, sampled, jnp.asarray(arrival, float), how)
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
        found, now = tried(torque, seen)
        if callback is not None:
            callback(step, now)
        nominally = nominally or now
        if (now.share, now.margin) > (best_held.share, best_held.margin):
            best, best_held = torque, now
        moves, state = adam.update(-found.slope * limit, state)
        share = jnp.clip(jnp.asarray(optax.apply_updates(share, moves)), -1.0, 1.0)
    assert nominally is not None
    return RobustSchedule(
        best,
        start,
        seen=(nominally, best_held),
        unseen=(tried(start, unseen)[1], tried(best, unseen)[1]),
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
def _objective_and_gradient(torque: TorqueSchedule, sampled: _Sampled, arrival, how: IntegratorOptions) -> _Climbed:
    """How a schedule does on all samples, and which way it gets better."""

    def objective(values) -> tuple[Float[Array, ""], tuple]:
        def one(sample: _Sampled):
            scene, at = sample
            found = simulate_phases(scene, TorqueSchedule(torque.times, values), at, how, arrival)
            least = jnp.stack([jnp.where(jnp.isfinite(o.score.margin), o.score.margin, NONE) for o in found]).min()
            ends = zip(scene.phases, found, at, strict=True)
            missed = jnp.stack([_arrival_penalty(o, t.table, p.arrive, arrival) for p, o, t in ends]).sum()
            holds = jnp.stack([o.verdict.status == int(Status.OK) for o in found]).all()
            moves = jnp.stack([jnp.isfinite(o.score.margin) for o in found]).all()
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
    each = [(scaled_mechanics(solid, scene.hand, scene.gravity, p.formation), t.table, o) for p, t, o in rows]
    return jnp.stack([certify_rest(mechanics, table, pad_schedule(torque), o) for mechanics, table, o in each]).all()


def _arrival_penalty(outcome, table, arrive: str, arrival):
    """How far beyond the tolerance a phase ends from where it should: a logarithm, lest the worst sample rule all."""
    at = outcome.motion.count
    off = [jnp.abs(table.breaks[-1] - outcome.motion.s[at]) / table.length / arrival]
    if arrive == "rest":
        off.append(outcome.motion.w[at] / table.length / jnp.sqrt(ARRIVAL_SPEED_FACTOR * arrival))
    return sum(jnp.log1p(jnp.maximum(one - WITHIN, 0.0) ** 2) for one in off)
