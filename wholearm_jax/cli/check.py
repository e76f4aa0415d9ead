"""`wholearm check`: one schedule or controller against very many scenes, in a store that the same command can resume.

Every process of a run (`--coordinator`, or SLURM's variables) computes each `--processes`-th chunk; the first process
makes the store, and summarises it at the end. Each process has one device for every processor that it may run on.
"""

import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from wholearm_jax.cli.arguments import (
    ARRIVAL_FRACTION,
    TORQUE_HELP,
    AsJson,
    BadInput,
    SceneName,
    note,
    parse_ensemble,
    refuse_unwritable,
)
from wholearm_jax.cli.prediction import note_doubtful_schedule, read_controller_of, refuse_short
from wholearm_jax.cli.processes import ProcessRank, join_processes, use_all_processors
from wholearm_jax.cli.progress import count_progress
from wholearm_jax.core import configure

SUMMARY_SUFFIXES = (".json", ".png", ".svg", ".pdf")  # of the files beside a store that bear its name
WELL_COMPILED_COUNT = 250_000  # scenes from which on compiling for run time pays (`benchmarks/batch.py`)
Vary = Annotated[list[str] | None, typer.Option("--vary", help="QUANTITY=AMOUNT, e.g. vertices=0.0005, friction=20%.")]


def check(
    scene: SceneName,
    out: Annotated[Path, typer.Option(help="The Zarr store of results; a summary and figures stand beside it.")],
    torque: Annotated[Path | None, typer.Option(help=f"{TORQUE_HELP} Or --controller, or --optimise.")] = None,
    controller: Annotated[Path | None, typer.Option(help="A controller.json: check in closed loop.")] = None,
    vary: Vary = None,
    polygons: Annotated[Path | None, typer.Option(help="Objects to put in the scene, .npz.")] = None,
    count: Annotated[int | None, typer.Option(min=1, help="How many scenes to draw.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of the draws.")] = 0,
    arrival: Annotated[
        float,
        typer.Option(
            min=1e-9, max=1.0, help="Arrived: this near the path's end, as a share of its length; 1e-6 for --optimise."
        ),
    ] = ARRIVAL_FRACTION,
    tolerance: Annotated[
        float, typer.Option(min=1e-12, max=1e-3, help="Of margins [N]; below 1e-9, all is computed as by `simulate`.")
    ] = 1e-6,
    chunk: Annotated[int, typer.Option(min=1, help="Scenes that are kept together.")] = 4096,
    optimise: Annotated[bool, typer.Option("--optimise", help="Optimise the schedule of each scene.")] = False,
    knots: Annotated[int, typer.Option(min=3, help="Torque knots a phase, with --optimise.")] = 51,
    coordinator: Annotated[str | None, typer.Option(help="HOST:PORT of the first of several processes.")] = None,
    processes: Annotated[int | None, typer.Option(min=1, help="How many processes there are.")] = None,
    process: Annotated[int | None, typer.Option(min=0, help="Which of them this is, from 0.")] = None,
    as_json: AsJson = False,
) -> None:
    """Check a schedule, or a controller, in many scenes.

    They vary one scene. The same command goes on where it was stopped.
    """
    if (polygons is None) == (count is None) or (polygons is None) != bool(vary):
        raise BadInput("check: give either --count, with --vary QUANTITY=AMOUNT, or --polygons FILE.npz")
    if (torque is None) == (controller is None) and not (optimise and torque is None):
        raise BadInput("check: give one of --torque FILE, --controller FILE and --optimise")
    if out.suffix in SUMMARY_SUFFIXES:
        raise BadInput(f"--out {out}: {out.suffix} is what stands beside the store; name the store otherwise, as .zarr")
    from wholearm_jax.files import count_polygons, read_polygons

    expected = count_polygons(polygons) if polygons else count or 0
    configure(optimise_for="compile_time" if expected < WELL_COMPILED_COUNT else "run_time")
    use_all_processors()
    rank = join_processes(coordinator, processes, process)
    loaded = _load_moving(scene)
    actuation = None if optimise else _read_actuation(loaded, torque, controller, rank)
    if optimise and (torque or controller) and rank.is_first:
        note(f"with --optimise each scene gets a schedule of its own: {torque or controller} is not followed")
    source = read_polygons(polygons, loaded) if polygons else parse_ensemble(loaded, vary, seed)
    total = count if count is not None else int(source.scenes.object.mass.shape[0])  # pyright: ignore
    limits = {"arrival": None, "tolerance": None} if optimise else {"arrival": arrival, "tolerance": tolerance}
    settings = limits | {"optimise": knots if optimise else None, "seed": seed}
    job = _Job(source, actuation, settings, total, min(chunk, total), optimise, knots, None if optimise else controller)
    _run(job, loaded, out, rank, as_json)
    sys.exit(0)


def _load_moving(name: str):
    """Load a scene whose phases all move, once Zarr is known to be there."""
    try:
        import zarr  # noqa: F401
    except ModuleNotFoundError:
        raise BadInput("checking many scenes needs Zarr: pip install 'wholearm_jax[batch]'") from None
    from wholearm_jax.files import load
    from wholearm_jax.phases import require_motion

    scene = load(name)
    try:
        require_motion(scene)
    except ValueError as error:
        raise BadInput(f"{name}: {error}") from None
    return scene


def _read_actuation(scene, torque: Path | None, controller: Path | None, rank: ProcessRank):
    """Read the schedule, or the law, that all scenes follow."""
    if torque is not None:
        return _read_schedule(scene, torque, rank)
    assert controller is not None
    from wholearm_jax.feedback import law_tables

    return law_tables(read_controller_of(scene, controller))


def _read_schedule(scene, torque: Path, rank: ProcessRank):
    """Read the schedule that all scenes follow."""
    from wholearm_jax.files import read_torque

    schedule = read_torque(torque)
    refuse_short(scene, schedule, torque)
    if rank.is_first:
        note_doubtful_schedule(scene, schedule, torque)
    return schedule


@dataclass(frozen=True)
class _Job:
    """The scenes to compute, and how."""

    source: Any  # of scenes: an ensemble or a batch
    actuation: Any  # the schedule, or the law, that all follow; None with `optimise`
    settings: dict[str, Any]
    count: int  # of scenes
    chunk: int  # scenes a chunk
    optimise: bool
    knots: int  # a phase, with `optimise`
    controller: Path | None  # file of the law, if there is one

    @property
    def schedule_rows(self) -> int:
        """Rows of the schedule that each scene has for itself; 0 where all follow the given one."""
        return self.knots * len(self.source.draw(0).phases) if self.optimise else 0


def _run(job: _Job, scene, out: Path, rank: ProcessRank, as_json: bool) -> None:
    """Fill the store with all other processes; the first process prints and writes the summary."""
    from wholearm_jax.cli.tables import print_json
    from wholearm_jax.files.check_store import fingerprint, store_metadata

    kind = "torque" if job.controller is None else "controller"
    digests = {"scenes": fingerprint(job.source), kind: fingerprint(job.actuation)}
    metadata = store_metadata(job.count, job.chunk, **job.settings, **digests)
    store = _open_shared_store(out, metadata, job, rank)
    _fill(store, job, rank)
    rank.wait_for_others("filled")
    if rank.is_first:
        lines, content = _summarise(store, scene, job.source, out, job.controller)
        if as_json:
            print_json(content)
        else:
            print("\n".join(lines))


def _open_shared_store(out: Path, metadata, job: _Job, rank: ProcessRank):
    """Open the store; the first process makes it, the others open it then."""
    from wholearm_jax.files.check_store import open_store

    store = open_store(out, metadata, job.schedule_rows) if rank.is_first else None
    rank.wait_for_others("store")
    return store if store is not None else open_store(out, metadata, job.schedule_rows)


def _fill(store, job: _Job, rank: ProcessRank) -> None:
    """Compute and write the missing chunks of this process."""
    done = store.done()
    missing = [k for k in range(rank.number, store.chunks, rank.count) if not done[k]]
    if not missing:
        return
    with count_progress("{task.fields[rate]}") as progress:
        total = sum(min(store.chunk, store.count - k * store.chunk) for k in missing)
        bar, begun, written = progress.add_task("scenes", total=total, rate="compiling"), None, 0
        for number, values in _optimise_chunks(job, missing) if job.optimise else _check_chunks(job, missing):
            store.write(number, values)
            size = len(values["status"])
            written += size if begun is not None else 0  # the first chunk's time is that of compiling
            begun = begun or time.perf_counter()
            rate = written / max(time.perf_counter() - begun, 1e-9)
            progress.update(bar, advance=size, rate=f"{rate:.0f}/s" if written else "")


def _check_chunks(job: _Job, missing: list[int]) -> Iterator[tuple[int, dict]]:
    """Check the scenes of each missing chunk: yield its number and columns."""
    from wholearm_jax.ensembles import check_in_chunks

    settings = {"tolerance": job.settings["tolerance"], "arrival": job.settings["arrival"]}
    parts = check_in_chunks(job.source, job.actuation, job.count, chunk=job.chunk, chunk_numbers=missing, **settings)
    for number, part in parts:
        yield number, part._asdict()


def _optimise_chunks(job: _Job, missing: list[int]) -> Iterator[tuple[int, dict]]:
    """Optimise the scenes of each missing chunk, one scene a processor: yield its number and columns."""
    from concurrent.futures import ThreadPoolExecutor

    import jax
    import numpy as np

    from wholearm_jax.ensembles import BatchResult, from_result
    from wholearm_jax.optimisation import optimise

    def optimise_scene(number):
        optimum = optimise(job.source.draw(number), knots=job.knots)
        schedule = np.column_stack([np.asarray(optimum.torque.times), np.asarray(optimum.torque.values)])
        return from_result(optimum.result), schedule

    with ThreadPoolExecutor(len(jax.local_devices())) as pool:
        for number in missing:
            rows = range(number * job.chunk, min(job.count, (number + 1) * job.chunk))
            results, schedules = zip(*pool.map(optimise_scene, rows), strict=True)
            columns = [np.stack([np.asarray(value) for value in column]) for column in zip(*results, strict=True)]
            yield number, {**BatchResult(*columns)._asdict(), "torque": np.stack(schedules)}


def _summarise(store, scene, source, out: Path, controller: Path | None):
    """Summarise the store, and write `NAME.json` and figures next to it; return the lines to print, and the content.

    The content names the `controller`, if there is one.
    """
    import json

    import jax
    import numpy as np

    from wholearm_jax.core import write_atomically
    from wholearm_jax.ensembles import Ensemble, most_influential, rank_correlations, summarise
    from wholearm_jax.files import FileSet, null_for_undefined, replace_files
    from wholearm_jax.plotting import plot_ensemble, save_figure

    summary = summarise(scene, (store.read(k) for k in range(store.chunks)), store.count)
    mapped, more = (), {}
    law = {} if controller is None else {"controller": str(controller)}
    if isinstance(source, Ensemble) and source.parameters:
        offsets = np.asarray(jax.lax.map(source.draw_offsets, summary.numbers, batch_size=1024))
        influence = rank_correlations(summary.margins, offsets)
        mapped = tuple((source.parameters[k], offsets[:, k]) for k in most_influential(source.parameters, influence))
        pairs = zip(source.parameters, influence.tolist(), strict=True)
        more = {"influence": {name: rank for name, rank in pairs if rank}}
    files = FileSet(f"{out.stem}.json", (), (out.stem,))
    with refuse_unwritable(str(out)), replace_files(out.parent, files) as scratch:
        content = null_for_undefined(law | summary.as_dict() | more)
        write_atomically(scratch / f"{out.stem}.json", json.dumps(content, indent=1, allow_nan=False) + "\n")
        save_figure(lambda: plot_ensemble(summary, more.get("influence"), mapped), scratch, out.stem)
    return summary.lines, content
