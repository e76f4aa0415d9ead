"""Margins of one torque schedule over sampled scenes, and the derivative of the objective of robust optimisation.

The contact paths of sampled scenes do not depend on torque: they are traced once. The objective is the smooth minimum
(`margin.log_barrier_minimum`) of all margins, minus a penalty for motions that miss their paths' ends.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from wholearm_jax.core import CachedJit, Status
from wholearm_jax.dynamics import PathDynamics
from wholearm_jax.ensembles.ensemble import Ensemble
from wholearm_jax.margin import log_barrier_minimum
from wholearm_jax.model import Arrival, Scene, TorqueSchedule, pad_schedule, rigid_body, scaled_mechanics
from wholearm_jax.phases import (
    ARRIVAL_SPEED_FACTOR,
    SimulatedPhase,
    TracedPhase,
    certify_rest,
    simulate_phases,
    trace,
)
from wholearm_jax.simulation import IntegratorOptions
from wholearm_jax.tracing import Resolution

SAMPLE_RESOLUTION = Resolution(6, 24, 8)
FREE_FRACTION = 0.5  # fraction of the arrival tolerance below which a phase's end is not penalised
NO_MOTION_MARGIN = -10.0  # [N], counted for a phase without any motion
RELATIVE_MU = 0.02  # barrier parameter of the smooth minimum, as a fraction of the largest margin


class SampledScenes(NamedTuple):
    """Scenes along a leading axis, and their traced phases."""

    scenes: Scene
    traced: tuple[TracedPhase, ...]


class SampledMargins(NamedTuple):
    """A schedule's result on every sample, and the objective's derivative with respect to the torques."""

    margins: Float[Array, "samples"]  # [N], -inf without any motion
    holds: Bool[Array, "samples"]  # every phase is ok
    rest_certified: Bool[Array, "samples"]  # friction provably holds the object wherever it rests
    gradient: Float[Array, "rows 2"]  # [1/m]


@CachedJit
def trace_samples(ensemble: Ensemble, numbers) -> SampledScenes:
    """Draw scenes of an ensemble and trace their phases."""

    def trace_scene(number):
        scene = ensemble.draw(number)
        return SampledScenes(scene, trace(scene, resolution=SAMPLE_RESOLUTION))

    return jax.lax.map(trace_scene, numbers, batch_size=32)


@CachedJit
def margins_and_gradient(
    torque: TorqueSchedule, samples: SampledScenes, arrival, options: IntegratorOptions
) -> SampledMargins:
    """Simulate a schedule on all samples, and differentiate the objective."""

    def objective(values) -> tuple[Float[Array, ""], tuple]:
        def evaluate_sample(sample: SampledScenes):
            scene, traced = sample
            phases = simulate_phases(scene, TorqueSchedule(torque.times, values), traced, options, arrival)
            margins = [p.margin_result.margin for p in phases]
            has_motion = jnp.stack([jnp.isfinite(m) for m in margins]).all()
            least = jnp.stack([jnp.where(jnp.isfinite(m), m, NO_MOTION_MARGIN) for m in margins]).min()
            ends = zip(scene.phases, phases, traced, strict=True)
            penalty = jnp.stack([_arrival_penalty(o, t.dynamics, p.arrive, arrival) for p, o, t in ends]).sum()
            holds = jnp.stack([p.assessment.status == int(Status.OK) for p in phases]).all()
            return least, penalty, holds, has_motion, _certify_rests(sample, torque, phases)

        margins, penalty, holds, has_motion, certified = jax.vmap(evaluate_sample)(samples)
        weights = jnp.full(margins.shape, 1.0 / margins.shape[0])
        scale = jnp.maximum(jnp.abs(jax.lax.stop_gradient(margins)).max(), 1e-3)
        smooth, _ = log_barrier_minimum(margins, weights, RELATIVE_MU * scale)
        return smooth - scale * penalty.mean(), (jnp.where(has_motion, margins, -jnp.inf), holds, certified)

    gradient, (margins, holds, certified) = jax.grad(objective, has_aux=True)(torque.values)
    return SampledMargins(margins, holds, certified, gradient)


def _certify_rests(
    sample: SampledScenes, torque: TorqueSchedule, phases: tuple[SimulatedPhase, ...]
) -> Bool[Array, ""]:
    """Say whether friction provably holds the object wherever it rests in one sample."""
    scene, traced = sample
    body, certified = rigid_body(scene.object), []
    for phase, path, simulated in zip(scene.phases, traced, jax.lax.stop_gradient(phases), strict=True):
        mechanics = scaled_mechanics(body, scene.hand, scene.gravity, phase.formation)
        certified.append(certify_rest(mechanics, path.dynamics, pad_schedule(torque), simulated))
    return jnp.stack(certified).all()


def _arrival_penalty(simulated: SimulatedPhase, dynamics: PathDynamics, arrive: Arrival, arrival):
    """Penalise the distance and speed with which a phase misses its end; logarithmic, lest the worst sample rule."""
    last = simulated.motion.count
    misses = [jnp.abs(dynamics.breakpoints[-1] - simulated.motion.s[last]) / dynamics.length / arrival]
    if arrive is Arrival.AT_REST:
        misses.append(simulated.motion.w[last] / dynamics.length / jnp.sqrt(ARRIVAL_SPEED_FACTOR * arrival))
    return sum(jnp.log1p(jnp.maximum(miss - FREE_FRACTION, 0.0) ** 2) for miss in misses)
