"""The work of one process of the stability sweep: trace, simulate and check blocks of scenes, level by level."""

import time
from pathlib import Path

import jax
import numpy as np

from benchmarks.stability import checks
from benchmarks.stability.gradients import check_gradients
from benchmarks.stability.levels import DOUBLE, SINGLE, STATUSES, Precision, batches, blank, picked, to_device
from benchmarks.stability.motions import simulate
from benchmarks.stability.programs import tracer
from benchmarks.stability.refusals import refuse
from benchmarks.stability.scenes import BLOCK, Scenes, draw
from wholearm_jax.core import configure
from wholearm_jax.tracing import Resolution


def work(blocks, seed, *, single, target: Path):
    """Run blocks of scenes and write one record a scene."""
    configure(optimise_for="run_time")
    jax.config.update("jax_enable_x64", not single)
    records = []
    for block in blocks:
        begun = time.perf_counter()
        scenes = draw(BLOCK, 1_000_003 * seed + block)
        found = swept(scenes, SINGLE if single else DOUBLE)
        records.append(found | {"block": np.full(BLOCK, block), "row": np.arange(BLOCK)})
        counts = zip(np.bincount(found["status"], minlength=len(STATUSES)), STATUSES, strict=True)
        named = ", ".join(f"{n} {name}" for n, name in counts if n)
        wrong = int((found["violations"] != 0).sum())
        print(f"block {block}: {time.perf_counter() - begun:.0f} s; {named}; {wrong} violations", flush=True)
    together = {key: np.concatenate([r[key] for r in records]) for key in records[0]}
    np.savez(target, **together)


def swept(scenes: Scenes, precision: Precision) -> dict[str, np.ndarray]:
    """One record a scene, from the first level at which nothing is left open."""
    found = blank(scenes)
    rows = np.arange(len(scenes.count))
    for number, level in enumerate(precision.levels):
        final = number == len(precision.levels) - 1
        later, ready = [], []
        for some, paths, tables in traced(scenes, rows, level):
            full = tables.count >= level.segments
            coarse = (tables.status == 0) & ~(tables.error <= precision.coarse)
            again = (full | coarse) & (not final) & (level.panels < precision.levels[-1].panels)
            status = np.where((tables.status == 0) & (full | coarse), checks.NO_CONVERGENCE, tables.status)
            later.append(some[again])
            refused = ~again & (status != 0)
            refuse(found, scenes, some, paths, tables, status, refused, precision.limits)
            good = np.flatnonzero(~again & (status == 0))
            ready.append((some[good], picked(paths, good), picked(tables, good)))
        found["level"][rows] = number
        for stepped in (False, True):
            for some, paths, tables in regrouped(ready, scenes, stepped, level.lanes):
                later.append(simulate(found, scenes, some, paths, tables, level, stepped, final, precision.limits))
        rows = np.sort(np.concatenate(later))
        if not len(rows):
            break
    for stepped in (False, True) if precision is DOUBLE else ():
        check_gradients(found, scenes, stepped, precision)
    return found


def traced(scenes, rows, level):
    """Paths and tables of some scenes, batch by batch, as NumPy."""
    program = tracer(Resolution(level.segments, level.panels, 8))
    for batch, real in batches(len(rows), level.lanes):
        some = rows[batch]
        paths, tables = program(to_device(Scenes(*scenes[some])))
        some = some[:real]
        paths, tables = jax.tree.map(lambda a, real=real: np.asarray(a)[:real], (paths, tables))
        yield some, paths, tables


def regrouped(ready, scenes, stepped, lanes):
    """Traced scenes with or without steps in their torque, in full batches."""
    if not ready:
        return
    rows = np.concatenate([some for some, _, _ in ready])
    paths, tables = (jax.tree.map(lambda *a: np.concatenate(a), *[part[k] for part in ready]) for k in (1, 2))
    mine = np.flatnonzero(scenes.stepped[rows] == stepped)
    for batch, real in batches(len(mine), lanes):
        at = mine[batch]
        yield (rows[at], real), picked(paths, at), picked(tables, at)
