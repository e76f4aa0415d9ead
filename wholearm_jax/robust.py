"""Robust: the torque schedule whose margin is the largest over a sample of scenes, not over one.

The wires of the sampled scenes do not depend on torque: they are traced once. The schedule climbs from that which is
best for the nominal scene, by gradient ascent on the smooth minimum (`forces.smooth_margin`) of all margins, less a
penalty for where the motions end. What counts is honest: the share of the samples that hold, then the margin at a low
quantile; the best schedule met on the way is kept, the nominal one among them.

Driven open loop, samples with other friction cannot all arrive exactly. A sample *holds* when every contact stays in
compression while each phase lasts and the phase ends within a share `arrival` of its wire's length of the end, at a
speed that fits (`verdict`); the next phase then starts at rest at the end, as in every plan.
"""

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

from wholearm_jax.batch import check
from wholearm_jax.forces import smooth_margin
from wholearm_jax.motion import Integration
from wholearm_jax.optimiser import optimise
from wholearm_jax.plan import Traced, outcomes, trace
from wholearm_jax.schedule import Torque
from wholearm_jax.status import Status
from wholearm_jax.variation import Ensemble
from wholearm_jax.wire import Resolution

COARSE = Resolution(6, 24, 8)
HOW = Integration(tolerance=1e-7, max_steps=128, stages=6, adjoint="both", steps=True)
TEMPERATURE = 0.02  # of the smooth minimum, as a share of the nominal margin


@dataclass(frozen=True)
class Held:
    """How a schedule does on scenes: the share that holds, and the margin [N] at the quantile asked for."""

    share: float
    margin: float


@dataclass(frozen=True)
class Robust:
    """A robust schedule beside the `nominal` one; `seen` and `unseen` are (nominal, robust) on the sampled scenes and
    on as many others."""

    torque: Torque
    nominal: Torque
    seen: tuple[Held, Held]
    unseen: tuple[Held, Held]


def optimise_robustly(
    ensemble: Ensemble,
    *,
    samples: int = 64,
    quantile: float = 0.0,
    knots: int = 51,
    steps: int = 60,
    arrival: float = 0.01,
    rate: float = 2e-3,
    nominal: Torque | None = None,
) -> Robust:
    """Maximise the margin at a low `quantile` (0: the worst) over the first `samples` scenes of an ensemble.

    `rate` is the step of Adam as a share of the torque limits. `nominal` starts from another schedule than
    `optimise(ensemble.scene)` finds.
    """
    scene = ensemble.scene
    start = optimise(scene, knots=knots).torque if nominal is None else nominal
    traced = _traced(ensemble, jnp.arange(samples))
    limit = scene.hand.torque_limit
    adam = optax.adam(rate)
    share = start.values / limit
    state = adam.init(share)
    best, best_key = start, (-np.inf, -np.inf)
    for _ in range(steps):
        torque = Torque(start.times, share * limit)
        (margins, holds), slope = _climb(torque, scene, traced, jnp.asarray(arrival))
        key = (float(holds.mean()), float(jnp.quantile(margins, quantile, method="lower")))
        if key > best_key:
            best, best_key = torque, key
        slope = jnp.where(jnp.isfinite(slope), slope, 0.0) * limit
        moves, state = adam.update(-slope, state)
        share = jnp.clip(share + moves, -1.0, 1.0)

    def held(torque, numbers):
        scenes = jax.lax.map(ensemble.draw, jnp.asarray(numbers))
        found = check(scenes, torque, arrival=arrival)
        lowest = np.quantile(found.margin, quantile, method="lower")
        return Held(float((found.status == Status.OK).mean()), float(lowest))

    both = (start, best)
    seen = tuple(held(torque, np.arange(samples)) for torque in both)
    unseen = tuple(held(torque, np.arange(samples, 2 * samples)) for torque in both)
    return Robust(best, start, seen, unseen)  # pyright: ignore[reportArgumentType]


@eqx.filter_jit
def _traced(ensemble: Ensemble, numbers) -> tuple[Traced, ...]:
    """The wires of some scenes."""
    return jax.lax.map(lambda n: trace(ensemble.draw(n), resolution=COARSE), numbers, batch_size=32)


@eqx.filter_jit
def _climb(torque: Torque, scene, traced, arrival):
    """Margins of all samples and whether they hold; the objective's derivative with respect to the torques."""

    def objective(values) -> tuple[Float[Array, ""], tuple]:
        def one(at):
            found = outcomes(scene, Torque(torque.times, values), at, HOW, arrival)
            least = jnp.stack([jnp.where(jnp.isfinite(o.score.margin), o.score.margin, -10.0) for o in found]).min()
            ends = [_missed(o, t.table, arrival) for o, t in zip(found, at, strict=True)]
            holds = jnp.stack([o.verdict.status == int(Status.OK) for o in found]).all()
            return least, sum(ends), holds

        margins, missed, holds = jax.vmap(one)(traced)
        weights = jnp.full(margins.shape, 1.0 / margins.shape[0])
        scale = jnp.maximum(jnp.abs(jax.lax.stop_gradient(margins)).max(), 1e-3)
        low, _ = smooth_margin(margins, weights, TEMPERATURE * scale)
        return low - scale * missed.mean(), (margins, holds)

    slope, answer = jax.grad(objective, has_aux=True)(torque.values)
    return answer, slope


def _missed(outcome, table, arrival):
    """How far beyond the tolerance a phase ends from where it should, squared."""
    at = outcome.motion.count
    place = jnp.abs(table.breaks[-1] - outcome.motion.s[at]) / table.length / arrival
    speed = outcome.motion.w[at] / table.length / jnp.sqrt(12 * arrival)
    return jnp.maximum(place - 0.5, 0.0) ** 2 + jnp.maximum(speed - 0.5, 0.0) ** 2
