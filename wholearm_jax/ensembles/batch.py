"""Check of one torque schedule against very many scenes, chunk by chunk and pass by pass.

A chunk is a number of blocks whose results are kept together. The first pass is coarse (`COARSE_PASS`: few panels and
steps) and knows its error. Scenes for which that error is too large, or which ran out of steps, are packed together and
checked again at full resolution (`FINE_PASS`); what is left is then simulated scene by scene. So neither the slowest
scene nor one that fails holds up the others or affects their results.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from wholearm_jax.core import on_host, require_positive, require_x64
from wholearm_jax.ensembles.ensemble import Ensemble
from wholearm_jax.ensembles.passes import run_pass
from wholearm_jax.ensembles.scene_batch import SceneBatch, SceneSource, stack_scenes
from wholearm_jax.ensembles.scene_check import COARSE_PASS, FINE_PASS, BatchResult, Fidelity, NextPass, from_result
from wholearm_jax.feedback import Controller, law_tables, require_same_plan
from wholearm_jax.model import LawTables, Scene, TorqueSchedule, pad_schedule
from wholearm_jax.phases import (
    CLOSED_LOOP_STEPS,
    CLOSED_LOOP_TOLERANCE,
    closed_loop_options,
    closed_loop_result,
    has_torque_jumps,
    require_covered,
    require_motion,
    require_phases,
    simulate,
)

CHUNK = 4096  # scenes whose results are kept together
BATCH_ARRIVAL = 0.01  # fraction of the path: scenes that vary cannot end exactly where the nominal scene must
LOOP_STEPS = 320  # of a phase in closed loop, in the first pass
MIN_COARSE_TOLERANCE = 1e-9  # [N], smaller tolerances begin at the full resolution


@on_host("check outside of the transformation; jax.vmap takes wholearm_jax.margin")
def check(
    scenes: Ensemble | Scene | Sequence[Scene],
    torque: TorqueSchedule | None = None,
    *,
    controller: Controller | LawTables | None = None,
    count: int | None = None,
    tolerance: float = 1e-6,
    arrival: float = BATCH_ARRIVAL,
    chunk: int = CHUNK,
    devices: Sequence[Any] | None = None,
) -> BatchResult:
    """Check a torque schedule, or a closed-loop law, against many scenes.

    Args:
        scenes: An ensemble, stacked scenes, or a sequence of scenes, which may differ in every number, in their
            formations and in the number of vertices (`scene_batch.stack_scenes`).
        torque: Schedule that covers the plan of every scene.
        controller: Instead of a schedule, the law that drives every scene (`feedback`).
        count: Number of scenes, counted from the first; required for an ensemble.
        tolerance: Error of the margins [N]: 1e-6, or below 1e-9 all is computed as by `simulate`.
        arrival: Distance from the path's end within which a phase must end, as a fraction of the path's length, at a
            speed that fits (`assessment.ARRIVAL_SPEED_FACTOR`). A plan that does not vary must come within 1e-6.
        chunk: Scenes whose intermediate results are in memory at once.
        devices: JAX devices to use; by default all local ones.

    Returns:
        Status, margin, time, contact, phase and end pose of each scene. A scene that fails never raises.

    Raises:
        ValueError: For one scene that is not stacked, a controller of another plan, a schedule shorter than a plan, a
            number that is not positive, or a `count` of more scenes than are given.
    """
    if isinstance(scenes, Scene) and np.ndim(scenes.object.mass) == 0:
        raise ValueError("this is one scene: check [scene], or vary it (wholearm_jax.ensembles.make_ensemble)")
    source = (
        scenes
        if isinstance(scenes, Ensemble)
        else SceneBatch(scenes if isinstance(scenes, Scene) else stack_scenes(scenes))
    )
    if count is None:
        if isinstance(source, Ensemble):
            raise ValueError("an ensemble has no end: say how many of its scenes to check, with count")
        count = source.count
    elif isinstance(source, SceneBatch) and count > source.count:
        raise ValueError(f"count is {count}, but {source.count} scenes are given")
    actuation = choose_actuation(source, torque, controller)
    chunks = check_in_chunks(
        source, actuation, count, tolerance=tolerance, arrival=arrival, chunk=chunk, devices=devices
    )
    return BatchResult(*(np.concatenate(column) for column in zip(*(part for _, part in chunks), strict=True)))


def check_in_chunks(
    source: Ensemble | SceneBatch,
    torque: TorqueSchedule | LawTables,
    count: int,
    *,
    tolerance: float = 1e-6,
    arrival: float = BATCH_ARRIVAL,
    chunk: int = CHUNK,
    devices: Sequence[Any] | None = None,
    chunk_numbers: Sequence[int] | None = None,
) -> Iterator[tuple[int, BatchResult]]:
    """Check scenes one chunk after the other, and yield each chunk's number and results.

    `torque` may be a closed-loop law; `chunk_numbers` selects chunks and their order (default: all); the other
    arguments are those of `check`.
    """
    require_x64(source.nominal, torque)
    require_positive(count=count, tolerance=tolerance, arrival=arrival, chunk=chunk)
    require_motion(source.nominal)  # holds need linear programmes, which compiled checks leave out
    if isinstance(torque, LawTables):
        require_phases(source.nominal, torque)
    else:
        require_covered(source.nominal, torque)
    mesh = Mesh(np.asarray(devices or jax.local_devices()), ("scenes",))
    passes = (COARSE_PASS, FINE_PASS) if tolerance >= MIN_COARSE_TOLERANCE else (FINE_PASS,)
    for number in range(-(-count // chunk)) if chunk_numbers is None else chunk_numbers:
        scenes = np.arange(number * chunk, min(count, (number + 1) * chunk))
        yield number, _check_chunk(source, scenes, torque, jnp.asarray(arrival), passes, mesh)


def _check_chunk(
    source: Ensemble | SceneBatch,
    numbers: np.ndarray,
    torque: TorqueSchedule | LawTables,
    arrival,
    passes: tuple[Fidelity, ...],
    mesh,
) -> BatchResult:
    """Check the scenes `numbers` pass by pass, and simulate alone those that no pass settles.

    Plans with a free finger have no pass.
    """
    if any(phase.has_free_finger for phase in source.nominal.phases):
        alone = [_check_alone(source, number, torque, float(arrival)) for number in numbers]
        return BatchResult(*(np.stack(column) for column in zip(*alone, strict=True)))
    schedule = torque if isinstance(torque, LawTables) else pad_schedule(torque)
    results, rows, single = None, np.arange(len(numbers)), []
    for fidelity in passes:
        fidelity = _fidelity_for(source.nominal, torque, fidelity)
        part, next_pass = run_pass(source, numbers[rows], schedule, arrival, fidelity, mesh)
        if results is None:
            results = part
        else:
            _overwrite(results, rows, part)
        single.append(rows[next_pass == NextPass.SINGLE])
        rows = rows[next_pass == NextPass.REFINE]
        if not len(rows):
            break
    assert results is not None
    for row in np.concatenate([*single, rows]):
        _overwrite(results, row, _check_alone(source, numbers[row], torque, float(arrival)))
    return results


def _check_alone(
    source: Ensemble | SceneBatch, number, torque: TorqueSchedule | LawTables, arrival: float
) -> BatchResult:
    """Check one scene by its simulation, refined until all is fine."""
    scene = source.draw(jnp.asarray(number))
    if isinstance(torque, LawTables):
        return from_result(closed_loop_result(scene, torque, arrival=arrival))
    return from_result(simulate(scene, torque, arrival=arrival))


def _fidelity_for(nominal: Scene, torque: TorqueSchedule | LawTables, fidelity: Fidelity) -> Fidelity:
    """Return the fidelity with the options that a schedule, or a law, requires."""
    if isinstance(torque, LawTables):
        tolerance = max(fidelity.options.tolerance, CLOSED_LOOP_TOLERANCE)
        steps = LOOP_STEPS if fidelity is COARSE_PASS else CLOSED_LOOP_STEPS
        options = closed_loop_options(replace(fidelity.options, tolerance=tolerance), steps)
    else:
        options = replace(fidelity.options, has_jumps=has_torque_jumps(nominal, torque))
    return fidelity._replace(options=options)


def choose_actuation(
    source: SceneSource, torque: TorqueSchedule | None, controller: Controller | LawTables | None
) -> TorqueSchedule | LawTables:
    """Return the schedule or the law that drives the scenes; raises ValueError unless there is one of them."""
    if (torque is None) == (controller is None):
        raise ValueError("give either a torque schedule or a controller")
    if torque is not None:
        return torque
    if isinstance(controller, LawTables):
        return controller
    assert controller is not None
    require_same_plan(controller, source.draw(0) if isinstance(source, SceneBatch) else source.nominal)
    formations = [phase.formation for phase in source.nominal.phases] if isinstance(source, SceneBatch) else []
    if any((leaf != leaf[:1]).any() for leaf in map(np.asarray, jax.tree.leaves(formations))):
        raise ValueError("the controller is for one plan, but the scenes differ in their contact formations")
    return law_tables(controller)


def _overwrite(results: BatchResult, rows, part: BatchResult) -> None:
    """Write the results of some scenes into their rows."""
    for column, new in zip(results, part, strict=True):
        column[rows] = new
