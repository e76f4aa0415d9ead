"""Robust optimisation: the torque schedule whose margin is the largest over a sample of scenes.

Gradient ascent starts from the schedule that is best for the nominal scene, on the objective of `sampled_margins`.
Schedules are compared by exact numbers instead: the fraction of the samples that hold, then the margin at a low
quantile; the best schedule on the way is kept, the nominal one among them.

Driven open loop, samples with other friction cannot all arrive exactly. A sample *holds* when every contact stays in
compression while each phase lasts, and the phase ends within a fraction `arrival` of its path's length of the end, at a
speed that fits (`assessment`). The next phase then starts at rest at the end, as in every plan.

Derivation: section 11 of `docs/derivation.md`.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
import optax

from wholearm_jax.core import Status, require_positive, require_x64
from wholearm_jax.ensembles.ensemble import Ensemble
from wholearm_jax.ensembles.sampled_margins import SampledMargins, SampledScenes, margins_and_gradient, trace_samples
from wholearm_jax.model import TorqueSchedule, limit_violations
from wholearm_jax.optimisation import DEFAULT_KNOTS, optimise
from wholearm_jax.phases import has_torque_jumps, require_covered, require_motion, simulate, with_plan_step_capacity
from wholearm_jax.simulation import Adjoint, IntegratorOptions

SAMPLE_OPTIONS = IntegratorOptions(tolerance=1e-7, max_steps=128, max_stages=6, adjoint=Adjoint.REVERSE)


@dataclass(frozen=True)
class SampleScore:
    """Score of a schedule on sampled scenes: the fraction that holds, and the margin [N] at the chosen quantile."""

    success_rate: float
    margin: float


@dataclass(frozen=True)
class RobustSchedule:
    """Robust and nominal schedule with their scores, as pairs (nominal, robust).

    `in_sample` are the scores on the sampled scenes, `out_of_sample` those on as many others.
    """

    torque: TorqueSchedule
    nominal: TorqueSchedule
    in_sample: tuple[SampleScore, SampleScore]
    out_of_sample: tuple[SampleScore, SampleScore]


def optimise_robustly(
    ensemble: Ensemble,
    *,
    samples: int = 64,
    quantile: float = 0.0,
    knots: int = DEFAULT_KNOTS,
    steps: int = 60,
    arrival: float = 0.01,
    rate: float = 2e-3,
    nominal: TorqueSchedule | None = None,
    callback: Callable[[int, SampleScore], None] | None = None,
) -> RobustSchedule:
    """Maximise the margin at a low quantile over the first scenes of an ensemble.

    A sample that would hold is simulated by itself where a finger moves alone or stands away, and where the object
    waits and nothing proves that friction can keep it there (`rest_certificate`).

    Args:
        ensemble: Scenes whose phases all move the object.
        samples: Number of sampled scenes.
        quantile: Quantile of the samples' margins to maximise (0: the smallest).
        knots: Torque knots a phase of the nominal optimisation.
        steps: Iterations of Adam.
        arrival: Distance from the path's end within which a phase must end, as a fraction of the path's length.
        rate: Step of Adam, as a fraction of the torque limits.
        nominal: Schedule to start from; by default that of `optimise(ensemble.scene)`.
        callback: Receives each iteration's number and its schedule's score on the samples.

    Raises:
        ValueError: For a plan with a phase that holds the object, a number that is not positive, and a `nominal`
            schedule that is shorter than the plan or beyond the torque limits.
    """
    scene, limit = ensemble.scene, ensemble.scene.hand.torque_limit
    require_x64(scene)
    require_positive(samples=samples, knots=knots, steps=steps, arrival=arrival, rate=rate)
    require_motion(scene)
    start = optimise(scene, knots=knots).torque if nominal is None else nominal
    require_covered(scene, start)
    _require_within(limit, start)
    in_sample, out_of_sample = (trace_samples(ensemble, jnp.arange(samples) + first) for first in (0, samples))
    options = with_plan_step_capacity(SAMPLE_OPTIONS, scene, start)
    options = replace(options, has_jumps=has_torque_jumps(scene, start))
    has_free_finger = any(phase.has_free_finger for phase in scene.phases)

    def score(torque: TorqueSchedule, sampled: SampledScenes) -> tuple[SampledMargins, SampleScore]:
        result = margins_and_gradient(torque, sampled, jnp.asarray(arrival, float), options)
        holds = np.array(result.holds)
        for k in np.flatnonzero(holds & (has_free_finger | ~np.asarray(result.rest_certified))):
            sample = jax.tree.map(lambda leaf, k=k: leaf[k], sampled.scenes)
            holds[k] = simulate(sample, torque, arrival=arrival).status is Status.OK
        return result, SampleScore(float(holds.mean()), float(jnp.quantile(result.margins, quantile, method="lower")))

    adam = optax.adam(optax.cosine_decay_schedule(rate, steps, 0.05))
    fraction = start.values / limit  # of the torque limits
    state = adam.init(fraction)
    best, nominal_score, best_score = start, None, SampleScore(-1.0, -np.inf)
    for step in range(steps + 1):
        torque = TorqueSchedule(start.times, fraction * limit)
        result, current = score(torque, in_sample)
        if callback is not None:
            callback(step, current)
        nominal_score = nominal_score or current
        if (current.success_rate, current.margin) > (best_score.success_rate, best_score.margin):
            best, best_score = torque, current
        updates, state = adam.update(-result.gradient * limit, state)
        fraction = jnp.clip(jnp.asarray(optax.apply_updates(fraction, updates)), -1.0, 1.0)
    assert nominal_score is not None
    return RobustSchedule(
        best,
        start,
        in_sample=(nominal_score, best_score),
        out_of_sample=(score(start, out_of_sample)[1], score(best, out_of_sample)[1]),
    )


def _require_within(limits, torque: TorqueSchedule) -> None:
    """Raise ValueError for torques beyond their limits, which the ascent would keep if they scored best."""
    for finger, reached, _, limit in limit_violations(torque, limits):
        raise ValueError(f"the nominal torque of finger {finger} is {reached:g} N m, its limit {limit:g} N m")
