"""Check: one torque schedule against very many scenes, each traced, reduced, simulated, scored and judged.

Two programs, compiled side by side, serve all scenes: one traces the wires of a plan, the other reduces the equations
of motion on them and simulates; each is a scan over its phases. A CPU does a block of scenes one after the other, each
with loops that do what it needs and no more; a GPU does them side by side (`jax.vmap`). Where all scenes have the same
wires, these are traced once a block. Where there are several devices `shard_map` gives each its own block. A chunk is a
number of blocks. The first pass is coarse (`COARSE_PASS`): few panels, fewer steps. It knows its error; scenes for which that
is too large, or which ran out of steps, are packed together and done again at full resolution (`FINE_PASS`), and what is
left then alone, by `plan.simulate`. So neither the slowest scene nor one that cannot be followed holds up the others
or touches their results.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple, Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Bool, Float, Int

from wholearm_jax.core import Program, Status, call_in_background, require_positive, require_x64, wait_for
from wholearm_jax.dynamics import PathDynamics, tabulate_path_dynamics
from wholearm_jax.ensembles.ensemble import Ensemble, stack
from wholearm_jax.model import ContactFormation, Scene, TorqueSchedule, pad_schedule, rigid_body, scaled_mechanics
from wholearm_jax.phases import (
    Result,
    SimulatedPhase,
    certify_rest,
    final_configuration,
    has_torque_jumps,
    initial_carry,
    phase_inputs,
    require_covered,
    require_motion,
    scan_step,
    simulate,
    stack_trees,
    trace_paths_in_one_program,
)
from wholearm_jax.simulation import IntegratorOptions
from wholearm_jax.tracing import ContactPath, Resolution, placeholder_path

BLOCK = 128  # scenes that one device takes at once
CHUNK = 4096  # scenes whose results are kept together
BATCH_ARRIVAL = 0.01  # share of the wire: plans that vary cannot end where the one must that torques were made for
GOOD, FINER, ALONE = range(3)  # what becomes of a scene at a level
EXACT = 1e-9  # tolerances below this begin at the full resolution


class BatchResult(NamedTuple):
    """What became of scenes; leading axes run over them.

    `status` are `Status` values: that of the first phase that is not ok. `margin` [N] is the least over the plan, minus
    infinity where a phase has no motion to score. `phase`, `contact` (a row of the phase's `ContactFormation.names`, -1:
    none) and `time` [s] say where it failed, or where the margin is where it did not. `end` is `z` (SI) where the
    motion of the failed or last phase ended, NaN where that phase has no wire.
    """

    status: Int[Array | np.ndarray, "*scenes"]
    margin: Float[Array | np.ndarray, "*scenes"]
    time: Float[Array | np.ndarray, "*scenes"]
    contact: Int[Array | np.ndarray, "*scenes"]
    phase: Int[Array | np.ndarray, "*scenes"]
    end: Float[Array | np.ndarray, "*scenes 5"]


class Fidelity(NamedTuple):
    """How finely to compute, and the table error up to which the result counts."""

    resolution: Resolution
    options: IntegratorOptions
    error: float


COARSE_PASS = Fidelity(Resolution(4, 7, 8, 64), IntegratorOptions(tolerance=1e-8, max_steps=96, max_stages=4), 5e-7)
FINE_PASS = Fidelity(Resolution(), IntegratorOptions(), 1e-9)


class SceneSource(Protocol):
    """What scenes come from: an `Ensemble`, or scenes that are given (`SceneBatch`)."""

    @property
    def nominal(self) -> Scene:
        """Its scene, or scenes, as far as all are alike in: phases, their names and how they arrive."""
        ...

    @property
    def same_wires(self) -> bool:
        """Whether all scenes have the wires of one."""
        ...

    def draw(self, number: Int[Array, ""]) -> Scene:
        """Scene number `number`."""
        ...


class SceneBatch(eqx.Module):
    """Scenes stacked along a leading axis (`variation.stack`)."""

    scenes: Scene

    @property
    def nominal(self) -> Scene:
        """The stacked scenes."""
        return self.scenes

    @property
    def same_wires(self) -> bool:
        """Not that it is known."""
        return False

    @property
    def count(self) -> int:
        """How many there are."""
        return self.scenes.object.mass.shape[0]

    def draw(self, number: Int[Array, ""]) -> Scene:
        """Scene number `number`."""
        return jax.tree.map(lambda leaf: leaf[number], self.scenes)

    def part(self, numbers: np.ndarray) -> "SceneBatch":
        """Some of the scenes, numbered anew."""
        return SceneBatch(jax.tree.map(lambda leaf: jnp.asarray(leaf[numbers]), self.scenes))


class _Stop(NamedTuple):
    """One phase of a check."""

    status: Int[Array, ""]
    margin: Float[Array, ""]
    margin_time: Float[Array, ""]
    margin_contact: Int[Array, ""]
    time: Float[Array, ""]
    contact: Int[Array, ""]
    end: Float[Array, "5"]
    good: Bool[Array, ""]
    held: Bool[Array, ""]


def check(
    scenes: Ensemble | Scene | Sequence[Scene],
    torque: TorqueSchedule,
    *,
    count: int | None = None,
    tolerance: float = 1e-6,
    arrival: float = BATCH_ARRIVAL,
    chunk: int = CHUNK,
    devices: Sequence[Any] | None = None,
) -> BatchResult:
    """Check a torque schedule against many scenes: the first `count` of an ensemble, or all that are given.

    `scenes` may differ in every number, in formations and in the number of vertices (see `variation.stack`).
    Margins are right to 1e-6 N; a `tolerance` [N] below 1e-9 has all computed as by `simulate`. A phase arrives when
    it ends within a share `arrival` of its wire's length of the end (1e-6 for a plan that does not vary, by
    `simulate`), at a speed that fits (`assessment.ARRIVAL_SPEED_FACTOR`). Memory is that of `chunk` scenes beside the result. Returns
    `BatchResult`: status, margin, time, contact, phase and end pose of each scene. Never raises for a scene that fails:
    that is a status. Raises ValueError for one scene that is not stacked, for a schedule shorter than a plan, for
    numbers that are not positive, and for a `count` of more scenes than are given.
    """
    if isinstance(scenes, Scene) and np.ndim(scenes.object.mass) == 0:
        raise ValueError("this is one scene: check [scene], or vary it (wholearm_jax.ensembles.ensemble.vary)")
    source = (
        scenes if isinstance(scenes, Ensemble) else SceneBatch(scenes if isinstance(scenes, Scene) else stack(scenes))
    )
    if count is None:
        if isinstance(source, Ensemble):
            raise ValueError("an ensemble has no end: say how many of its scenes to check, with count")
        count = source.count
    elif isinstance(source, SceneBatch) and count > source.count:
        raise ValueError(f"count is {count}, but {source.count} scenes are given")
    parts = check_in_chunks(source, torque, count, tolerance=tolerance, arrival=arrival, chunk=chunk, devices=devices)
    return BatchResult(*(np.concatenate(column) for column in zip(*(part for _, part in parts), strict=True)))


def check_in_chunks(
    source: Ensemble | SceneBatch,
    torque: TorqueSchedule,
    count: int,
    *,
    tolerance: float = 1e-6,
    arrival: float = BATCH_ARRIVAL,
    chunk: int = CHUNK,
    devices: Sequence[Any] | None = None,
    wanted: Sequence[int] | None = None,
) -> Iterator[tuple[int, BatchResult]]:
    """`check` one chunk after the other: numbers of chunks (those `wanted`, by default all) with their results."""
    require_x64()
    require_positive(count=count, tolerance=tolerance, arrival=arrival, chunk=chunk)
    require_motion(source.nominal)  # holds need linear programmes, which compiled checks leave out
    require_covered(source.nominal, torque)
    mesh = Mesh(np.asarray(devices or jax.local_devices()), ("scenes",))
    levels = (COARSE_PASS, FINE_PASS) if tolerance >= EXACT else (FINE_PASS,)
    for number in range(-(-count // chunk)) if wanted is None else wanted:
        rows = np.arange(number * chunk, min(count, (number + 1) * chunk))
        yield number, _check_rows(source, rows, torque, jnp.asarray(arrival), levels, mesh)


def _check_rows(source, rows, torque: TorqueSchedule, arrival, levels, mesh) -> BatchResult:
    """Check some scenes, level by level; alone those of the last that are not good, and of any that want `ALONE`."""
    schedule, steps = pad_schedule(torque), has_torque_jumps(source.nominal, torque)
    found, left, alone = None, np.arange(len(rows)), []
    for level in levels:
        level = level._replace(options=replace(level.options, has_jumps=steps))
        answer, grade = _check_packed(source, rows[left], schedule, arrival, level, mesh)
        if found is None:
            found = answer
        else:
            for column, new in zip(found, answer, strict=True):
                column[left] = new
        alone.append(left[grade == ALONE])
        left = left[grade == FINER]
        if not len(left):
            break
    assert found is not None
    for row in np.concatenate([*alone, left]):
        answer = _check_alone(source.draw(rows[row]), torque, arrival)
        for column, new in zip(found, answer, strict=True):
            column[row] = new
    return found


def _check_packed(source, rows, schedule, arrival, level: Fidelity, mesh: Mesh):
    """Check scenes block by block, the last block filled up with its last scene."""
    size = BLOCK * mesh.size
    filled = np.append(rows, np.repeat(rows[-1:], -len(rows) % size))
    answers = []
    for block in filled.reshape(-1, size):
        few = source if isinstance(source, Ensemble) else source.part(block)
        numbers = block if isinstance(source, Ensemble) else np.arange(size)
        answers.append(_check_block(few, jnp.asarray(numbers), schedule, arrival, level, mesh))
    columns = jax.tree.map(lambda *parts: np.concatenate([np.asarray(p) for p in parts])[: len(rows)], *answers)
    return columns


def _check_block(source: SceneSource, numbers, schedule: TorqueSchedule, arrival, level: Fidelity, mesh: Mesh):
    """Check `BLOCK` scenes a device: on a processor one after the other."""
    side_by_side = mesh.devices.flat[0].platform != "cpu"
    told = source, schedule, arrival, level, side_by_side
    compiled = call_in_background(_check_blank, mesh, told, numbers)
    paths = _on(mesh, _wires_of, (source, level.resolution, side_by_side), numbers)
    wait_for(compiled)
    return _on(mesh, _checks_of, told, numbers, paths)


def _check_blank(mesh: Mesh, told: tuple, numbers) -> None:
    """Check scenes on wires that were not found: that compiles the program for those that were."""
    source, _, _, level, _ = told
    shape = mesh.size if source.same_wires else len(numbers), len(source.nominal.phases)
    paths = jax.tree.map(lambda a: np.broadcast_to(a, (*shape, *a.shape)), placeholder_path(level.resolution))
    if mesh.size > 1:  # where those that are traced will be
        paths = jax.device_put(paths, NamedSharding(mesh, PartitionSpec("scenes")))
    _on(mesh, _checks_of, told, numbers, paths)


def _on(mesh: Mesh, program: Program, told: tuple, *each):
    """Call a program on all devices, with what all are `told` and what is `each` one's own."""
    return program(told, *each) if mesh.size == 1 else _apart(mesh, program, told, *each)


@Program
def _apart(mesh: Mesh, program: Program, told: tuple, *each):
    arrays, static = eqx.partition(told, eqx.is_array)

    def local(arrays, *each):
        return program(eqx.combine(arrays, static), *each)

    own, whole = PartitionSpec("scenes"), PartitionSpec()
    specs = (whole, *(own for _ in each))
    return jax.shard_map(local, mesh=mesh, in_specs=specs, out_specs=own, check_vma=False)(arrays, *each)


@Program
def _wires_of(told, numbers):
    """The wires of scenes: of one alone where all have the same."""
    source, resolution, side_by_side = told

    def one(number):
        return trace_paths_in_one_program(source.draw(number), resolution)

    return _each(one, side_by_side)(numbers[:1] if source.same_wires else numbers)


@Program
def _checks_of(told, numbers, paths):
    """Check scenes on their wires."""
    source, schedule, arrival, level, side_by_side = told

    def on_wires(number, paths):
        return check_wires(source.draw(number), paths, schedule, arrival, level)

    if source.same_wires:
        shared = jax.tree.map(lambda a: a[0], paths)
        return _each(lambda number: on_wires(number, shared), side_by_side)(numbers)
    return _each(lambda one: on_wires(*one), side_by_side)((numbers, paths))


def _each(function, side_by_side: bool):
    """A function of many, side by side or one after the other."""
    return jax.vmap(function) if side_by_side else partial(jax.lax.map, function)


def check_scene(scene: Scene, schedule: TorqueSchedule, arrival, level: Fidelity) -> tuple[BatchResult, Int[Array, ""]]:
    """Check one scene (under any transformation), and say whether this level's result is `GOOD`, or wants a `FINER` one
    or `simulate` for this scene `ALONE`."""
    return check_wires(scene, trace_paths_in_one_program(scene, level.resolution), schedule, arrival, level)


def check_wires(
    scene: Scene, paths: ContactPath, schedule: TorqueSchedule, arrival, level: Fidelity
) -> tuple[BatchResult, Int[Array, ""]]:
    """Check one scene on its wires."""
    solid = rigid_body(scene.object)

    def one(clock, phase):
        path, motion, formation = phase
        mechanics = scaled_mechanics(solid, scene.hand, scene.gravity, formation)
        dynamics = tabulate_path_dynamics(mechanics, path)
        clock, done = scan_step(schedule, level.options, arrival, clock, (dynamics, *motion))
        held = certify_rest(mechanics, dynamics, schedule, done)
        return clock, _stop(dynamics, done, formation, level, held)

    told = stack_trees([(phase_inputs(p), p.formation) for p in scene.phases])
    _, stops = jax.lax.scan(one, initial_carry(schedule), (paths, *told))
    failed = stops.status != int(Status.OK)
    where = jnp.where(failed.any(), jnp.argmax(failed), jnp.argmin(stops.margin))
    last = jnp.where(failed.any(), where, len(scene.phases) - 1)
    # What follows a failure counts for nothing but the margin; where it has none, that is known.
    counts = jnp.arange(len(scene.phases)) <= last
    needed = counts | (stops.status != int(Status.NO_CONVERGENCE))
    ok = ~failed.any()
    answer = BatchResult(
        status=stops.status[where],
        margin=stops.margin.min(),
        time=jnp.where(ok, stops.margin_time, stops.time)[where],
        contact=jnp.where(ok, stops.margin_contact, stops.contact)[where],
        phase=where,
        end=stops.end[last],
    )
    # Where only a linear programme can tell whether friction holds a rest, `simulate` asks it.
    doubtful = jnp.any(~stops.held & counts)
    return answer, jnp.select([jnp.any(~stops.good & needed), doubtful], [FINER, ALONE], GOOD)


def _stop(dynamics: PathDynamics, done: SimulatedPhase, formation: ContactFormation, level: Fidelity, held) -> _Stop:
    """One phase's result, and whether it is to be trusted: a fine table, and neither steps nor pieces used up; rests
    that are `held` for sure."""
    motion = done.motion
    known = jnp.isfinite(done.margin_result.margin) & (dynamics.status == 0)
    of_slot = jnp.cumsum(~formation.tangential) - 1
    status, contact = done.assessment.status, done.assessment.contact
    worth = (status != int(Status.MAX_STEPS)) & (status != int(Status.NO_CONVERGENCE))
    fine = (dynamics.error <= level.error) & (dynamics.count < level.resolution.segments)
    return _Stop(
        status=status,
        margin=jnp.where(known, done.margin_result.margin, -jnp.inf),
        margin_time=done.start + done.duration * done.margin_result.phase_time,
        margin_contact=of_slot[done.margin_result.contact],
        time=done.start + done.duration * done.assessment.phase_time,
        contact=jnp.where(contact >= 0, of_slot[contact], -1),
        end=jnp.where(dynamics.status == 0, final_configuration(dynamics, motion), jnp.nan),
        good=jnp.where(dynamics.status == 0, fine & worth, worth),
        held=held | (dynamics.status != 0),
    )


def _check_alone(scene: Scene, torque: TorqueSchedule, arrival) -> BatchResult:
    """One scene by `simulate`, which refines until all is fine."""
    return from_result(simulate(scene, torque, arrival=float(arrival)))


def from_result(result: Result) -> BatchResult:
    """A simulated plan as one scene of a check."""
    rows = list(result.phases)
    failed = next((k for k, p in enumerate(rows) if p.status is not Status.OK), None)
    where = int(np.argmin([p.margin for p in rows])) if failed is None else failed
    last = rows[-1 if failed is None else failed]
    p = rows[where]
    named = p.margin_contact if failed is None else p.contact
    dynamics, motion = last.traced.dynamics, last.outcome.motion
    end = final_configuration(dynamics, motion) if int(dynamics.status) == Status.OK else jnp.full(5, jnp.nan)
    return BatchResult(
        status=np.asarray(int(result.status)),
        margin=np.asarray(result.margin),
        time=np.asarray(p.margin_time if failed is None else p.time),
        contact=np.asarray(p.contacts.index(named) if named else -1),
        phase=np.asarray(where),
        end=np.asarray(end),
    )
