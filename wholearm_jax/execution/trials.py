r"""Perturb: a plan executed many times with friction, mass, geometry and start a little off, and how often it succeeds.

Every draw is uniform within plus or minus its amount, as in an ensemble (`ensembles.make_ensemble`): a factor on each
link's friction coefficient, one on the mass (and with it the inertia), an offset of each coordinate of each vertex, and
a displacement of the object's start in x, y and, over its radius, phi. The object that is then laid in the hand touches
as the first formation says: the start is the nearest configuration at which the perturbed object's gaps are 0
(least-norm Newton steps in object units); a contact that should roll may begin at any place of its link. Where a vertex
would lie in a link there, the object is laid where its own path begins (`tracing.settle_on_link`). The
torques stay those of the unperturbed plan. Success is counted twice: against the end of the unperturbed plan, and
against the end of the perturbed object's own path from where it was laid.
"""

# MuJoCo's names come from a compiled module, which type checkers cannot see into.
# pyright: reportAttributeAccessIssue=false

import itertools
import os
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from joblib import Parallel, delayed

from wholearm_jax.core import CachedJit, Status, require_positive, unstack_trees
from wholearm_jax.ensembles import Ensemble, make_ensemble, wilson_interval
from wholearm_jax.execution.closed_loop import (
    ControlledMotor,
    Hardware,
    closed_loop_step,
)
from wholearm_jax.execution.executions import (
    ExecutionOutcome,
    Tolerance,
    assess_execution,
    clock,
    motor_torques,
    require_paths,
    rollout,
    start_of,
    target_of,
)
from wholearm_jax.execution.least_forces import PlannedContacts, least_force, planned_contacts
from wholearm_jax.execution.link_meetings import unexpected_meetings
from wholearm_jax.execution.mujoco_model import ContactCompliance, MujocoModel, build_mujoco_model
from wholearm_jax.execution.pushes import Push
from wholearm_jax.feedback import Controller
from wholearm_jax.model import (
    Arrival,
    ContactFormation,
    Scene,
    contact_kinematics,
    gaps,
    normal_jacobian,
    remains_simple,
    rigid_body,
    scaled_mechanics,
)
from wholearm_jax.phases import Result, target_configuration, trace

ROUNDING = 1e-9  # depth that is none [object radii]


class Amounts(NamedTuple):
    """Half widths of the uniform draws: `friction` and `mass` relative, `geometry` and `start` in metres."""

    friction: float = 0.0
    mass: float = 0.0
    geometry: float = 0.0
    start: float = 0.0

    def __str__(self) -> str:
        relative = {"friction": self.friction, "mass": self.mass}
        lengths = {"vertices": self.geometry, "start": self.start}
        parts = [f"{name} {100 * width:.3g} %" for name, width in relative.items() if width]
        return ", ".join(parts + [f"{name} {1e3 * width:.3g} mm" for name, width in lengths.items() if width])


@dataclass(frozen=True)
class PerturbedRun:
    """One execution: factors and shifts drawn, where the object ended, and what that counts as.

    `ending` is judged by the end of the unperturbed plan, `own_ending` by `own_target`, the end of the perturbed
    object's own path, None where that has none. `scene` is the perturbed one, from where the object was laid, and
    `least_force` [N] that of the contacts that held the object on its way (`least_forces.least_force`).
    """

    scene: Scene
    friction: Float[np.ndarray, "3"]
    mass: float
    end: Float[np.ndarray, "5"]
    position_error: float
    angle_error: float
    ending: ExecutionOutcome
    own_target: Float[np.ndarray, "5"] | None
    own_ending: ExecutionOutcome
    least_force: float

    @property
    def own_position_error(self) -> float:
        """How far the object is from the end of its own path [m]; NaN where that has none."""
        return np.nan if self.own_target is None else float(np.hypot(*(self.end - self.own_target)[:2]))


@dataclass(frozen=True)
class TrialsResult:
    """Many perturbed executions; `interval` is the success rate's 95 % confidence interval (Wilson's)."""

    amounts: Amounts
    seed: int
    tolerance: Tolerance
    runs: tuple[PerturbedRun, ...]

    @property
    def successes(self) -> int:
        """How many end where the unperturbed plan does."""
        return sum(run.ending is ExecutionOutcome.OK for run in self.runs)

    @property
    def interval(self) -> tuple[float, float]:
        return wilson_interval(self.successes, len(self.runs))

    @property
    def own_successes(self) -> int:
        """How many end where the perturbed object's own path does."""
        return sum(run.own_ending is ExecutionOutcome.OK for run in self.runs)

    @property
    def message(self) -> str:
        """The success rate in one line, with what was perturbed."""
        low, high = self.interval
        share = 100 * self.successes / len(self.runs)
        span = f"95 % confidence interval {100 * low:.1f} to {100 * high:.1f} %"
        own = f"at the ends of their own paths: {self.own_successes}"
        kept = sum(run.least_force > 0 for run in self.runs)
        by = f"{self.amounts}: " if any(self.amounts) else ""
        return (
            f"{by}{self.successes} of {len(self.runs)} perturbed executions succeed: {share:.1f} %, {span}; {own};"
            f" all contacts kept on the way: {kept}"
        )


class Copy(NamedTuple):
    """One execution of a plan: on `scene`, its object's start displaced in x, y and r phi [m], under `pushes`."""

    scene: Scene
    displacement: Float[np.ndarray, "3"]
    pushes: tuple[Push, ...] = ()


def run_trials(
    prediction: Result,
    count: int,
    amounts: Amounts,
    *,
    seed: int = 0,
    tolerance: Tolerance = Tolerance(),
    pushes: Sequence[Push] = (),
    **settings: Any,
) -> TrialsResult:
    """Execute `count` perturbed copies of a plan, each under `pushes`; `settings` are those of `run_copies`.

    Raises ValueError as `run_copies` and `require_objects` do, and for a `count` that is not positive.
    """
    require_positive(count=count)
    require_paths(prediction)
    require_objects(prediction.scene, amounts)
    scenes = _draw_scenes(prediction.scene, amounts, seed, count)
    displacements = _draw_displacements(prediction.scene, amounts, seed, count)
    copies = [Copy(*drawn, tuple(pushes)) for drawn in zip(scenes, displacements, strict=True)]
    return TrialsResult(
        amounts, seed, tolerance, run_copies(prediction, copies, seed=seed, tolerance=tolerance, **settings)
    )


def run_copies(
    prediction: Result,
    copies: Sequence[Copy],
    *,
    seed: int = 0,
    timestep: float = 2e-4,
    softness: ContactCompliance = ContactCompliance(),
    tolerance: Tolerance = Tolerance(),
    workers: int | None = None,
    callback: Callable[[PerturbedRun], None] | None = None,
    controller: Controller | None = None,
    hardware: Hardware = Hardware(),
) -> tuple[PerturbedRun, ...]:
    """Execute copies of a plan in `workers` processes (default: one for each processor).

    `callback` sees each as it is done, in their order. A `controller` measures and acts through `hardware`, whose noise
    `seed` plus the copy's number draws. Raises ValueError as `require_paths` does, and for a `timestep` that is not
    positive.
    """
    require_positive(timestep=timestep)
    require_paths(prediction)
    begins, step = clock(prediction.scene, timestep)
    drives: Iterator = itertools.repeat(motor_torques(prediction.torque, begins, step))
    if controller is not None:
        step = closed_loop_step(controller, hardware, prediction.scene, timestep)
        drives = (ControlledMotor(controller, hardware, step, seed + k) for k in itertools.count())
    nominal, target = start_of(prediction), target_of(prediction)
    laid = [
        lay_in_hand(prediction, one.scene, start_near(one.scene, nominal, np.asarray(one.displacement)))
        for one in copies
    ]
    models = (
        (build_mujoco_model(one.scene, step, softness), path.start) for one, path in zip(copies, laid, strict=True)
    )
    pushed = [one.pushes for one in copies]
    workers, contacts = max(1, min(workers or os.cpu_count() or 1, len(copies))), planned_contacts(prediction.scene)
    runs = []
    for one, own, reached in zip(
        copies, laid, rollout_in_parallel(models, drives, workers, pushed, contacts), strict=True
    ):
        changed = eqx.tree_at(lambda s: s.start, one.scene, jnp.asarray(own.start))
        reached = reached._replace(met=unexpected_meetings(prediction, reached.met))
        runs.append(_summary(prediction.scene, changed, (target, own.target), reached, tolerance))
        if callback is not None:
            callback(runs[-1])
    return tuple(runs)


def require_objects(scene: Scene, amounts: Amounts) -> None:
    """Raise ValueError for amounts by which what is drawn may be no object."""
    if not 0 <= amounts.friction <= 1 or not 0 <= amounts.mass < 1:
        raise ValueError("friction, mass: shares of up to 1, of the mass less than 1")
    outline = np.asarray(scene.object.vertices)[: int(scene.object.count)]
    if not remains_simple(outline, np.full(len(outline), np.sqrt(2) * amounts.geometry)):
        raise ValueError(f"geometry {amounts.geometry:g}: too much, edges of the polygon could cross")


def _draw_scenes(scene: Scene, amounts: Amounts, seed: int, count: int) -> tuple[Scene, ...]:
    """Draw `count` scenes with other objects. Each amount keeps its own sequence, whatever the others are."""
    spreads = {
        "friction": f"{100 * amounts.friction!r}%",
        "mass": f"{100 * amounts.mass!r}%",
        "vertices": amounts.geometry,
    }
    ensemble = make_ensemble(scene, spreads, seed=seed)
    return unstack_trees(jax.device_get(_draw_many(ensemble, jnp.arange(count))), count)


@CachedJit
def _draw_many(ensemble: Ensemble, numbers: Int[Array, "scenes"]) -> Scene:
    return jax.vmap(ensemble.draw)(numbers)


@CachedJit
def _draw_many_offsets(ensemble: Ensemble, numbers: Int[Array, "scenes"]) -> Float[Array, "scenes offsets"]:
    return jax.vmap(ensemble.draw_offsets)(numbers)


def _draw_displacements(scene: Scene, amounts: Amounts, seed: int, count: int) -> Float[np.ndarray, "count 3"]:
    """Draw displacements [m] of the object's start in x, y and, over the object's radius, phi."""
    ensemble = make_ensemble(scene, {"start": amounts.start}, seed=seed)
    return np.asarray(_draw_many_offsets(ensemble, jnp.arange(count)))[:, :3] * amounts.start


def start_near(scene: Scene, z, shift) -> Float[np.ndarray, "5"]:
    """The configuration next to `z`, its object displaced by `shift` [m], at which the first formation's gaps are 0.

    A vertex that would then lie behind a link, as one of a side that was flush may, touches it instead.
    """
    return np.asarray(_touch_down(scene.object, scene.hand, scene.gravity, scene.phases[0].formation, z, shift))


@jax.jit
def _touch_down(shape, hand, gravity, formation: ContactFormation, z, shift) -> Float[Array, "5"]:
    mechanics = scaled_mechanics(rigid_body(shape), hand, gravity, formation)
    displaced = z / mechanics.configuration_unit + jnp.zeros(5).at[:3].set(shift / mechanics.length)
    is_gap = ~formation.tangential  # the second row of a rolling contact repeats its gap
    if formation.is_away is not None:
        is_gap = is_gap & ~formation.is_away

    def close(z, pair, closes):
        """Newton's steps of least length to the formation, and to one pair more where `closes`."""

        def closer(_, z):
            closed = jnp.append(is_gap, closes)
            rows = jnp.vstack([normal_jacobian(mechanics.contacts, z), normal_jacobian(pairs, z)[pair]])
            rows = jnp.where(closed[:, None], rows, 0.0)
            values = jnp.append(gaps(mechanics.contacts, z), gaps(pairs, z)[pair])
            gram = rows @ rows.T + jnp.diag(jnp.where(closed, 0.0, 1.0))
            return z - rows.T @ jnp.linalg.solve(gram, jnp.where(closed, values, 0.0))

        return jax.lax.fori_loop(0, 20, closer, z)

    pairs = mechanics.candidates
    near = close(displaced, 0, False)
    at = contact_kinematics(pairs, near)
    obstacles = mechanics.may_terminate & ~mechanics.may_be_behind & pairs.on_link
    depth = jnp.where(obstacles & (at.along > pairs.lower) & (at.along < pairs.upper), -at.gap, 0.0)
    deepest = jnp.argmax(depth)
    return close(near, deepest, depth[deepest] > ROUNDING) * mechanics.configuration_unit


class OwnPath(NamedTuple):
    """Where a perturbed object is laid, and where its own path ends; None where it has none, or moves at its end."""

    start: Float[np.ndarray, "5"]
    target: Float[np.ndarray, "5"] | None


def lay_in_hand(prediction: Result, scene: Scene, start) -> OwnPath:
    """Lay a perturbed object where its own path begins near `start`, which is free of overlaps; at `start` if nowhere.

    A plan that need not stand still at its end (`target_of`) has no end but the prediction's.
    """
    traced = trace(eqx.tree_at(lambda s: s.start, scene, jnp.asarray(start)))
    known = [int(phase.dynamics.status) == Status.OK for phase in traced]
    moving = prediction.phases[-1].arrive in (Arrival.MOVING, Arrival.ANY_SPEED)
    return OwnPath(
        start=np.asarray(traced[0].begin) if known[0] else start,
        target=np.asarray(target_configuration(scene.phases[-1], traced[-1])) if all(known) and not moving else None,
    )


class Reached(NamedTuple):
    """Where an execution ended: its last configuration, how far contacts crept, what met, and the least force."""

    z: Float[np.ndarray, "5"]
    creep: float
    met: Collection[str]
    least_force: float


def rollout_in_parallel(
    models: Iterable[tuple[MujocoModel, Float[np.ndarray, "5"]]],
    drives: Iterable,
    workers: int,
    pushes: Iterable[Sequence[Push]] = itertools.repeat(()),
    contacts: PlannedContacts = PlannedContacts((), np.zeros(0)),
) -> Iterator[Reached]:
    """Yield where free bodies end, driven from rest at their starts.

    `drives` are the torques of each, or its motor; `pushes` act on each beside them. The least force is that of
    `contacts`.
    """
    each = zip(models, drives, pushes, strict=False)
    tasks = (delayed(_drive)(*model, motor, pushed, contacts) for model, motor, pushed in each)
    return Parallel(n_jobs=workers, return_as="generator")(tasks)  # pyright: ignore[reportReturnType]


def _drive(bodies: MujocoModel, start, torques, pushes, contacts: PlannedContacts) -> Reached:
    step, phases = bodies.model.opt.timestep, []

    def motor(k: int, angles):
        torque = torques(k, angles)
        phases.append(torques.phase)
        return torque

    z, z_dot, forces, creep, met = rollout(bodies, start, motor if callable(torques) else torques, pushes)
    phase = (
        np.array(phases[:-1]) if callable(torques) else np.searchsorted(contacts.ends, np.arange(len(torques)) * step)
    )
    least = least_force(contacts, bodies.names, phase, z_dot[:-1, 3:], forces[:-1, :, 0], step)
    return Reached(z[-1], creep, met, least)


def _summary(scene: Scene, changed: Scene, targets, reached: Reached, tolerance: Tolerance) -> PerturbedRun:
    """Judge where a perturbed object ended by `targets`: the unperturbed plan's end and its own path's, or None."""
    end, (target, own) = reached.z, targets
    goals = [np.full(5, np.inf) if goal is None else goal for goal in targets]
    ending, own_ending = (
        assess_execution(changed, end, goal, tolerance, reached.creep, reached.met)[0] for goal in goals
    )
    was, now = (np.asarray(one.object.friction) for one in (scene, changed))
    return PerturbedRun(
        scene=changed,
        friction=np.where(was > 0, now / np.where(was > 0, was, 1.0), 1.0),
        mass=float(changed.object.mass / scene.object.mass),
        end=end,
        position_error=float(np.hypot(*(end - target)[:2])),
        angle_error=float((end - target)[2]),
        ending=ending,
        own_target=own,
        own_ending=own_ending,
        least_force=reached.least_force,
    )
