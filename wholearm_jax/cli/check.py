"""`wholearm check`: one schedule against very many scenes, in a store that can be gone on with.

Every process of a run (`--coordinator`, or SLURM's variables) takes each `--processes`-th chunk; the first one makes
the store and tells what became of all. Each process has one device for every processor that it may run on.
"""

import os
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from wholearm_jax.cli.arguments import (
    TORQUE,
    BadInput,
    SceneName,
    counting_progress,
    note,
    note_limit_violations,
    writing,
)
from wholearm_jax.core import configure

BESIDE = (".json", ".png", ".svg", ".pdf")  # what stands beside a store, under its name
MANY = 250_000  # scenes from which on compiling well, which takes 1.5 times as long, pays (`benchmarks/batch.py`)
ARRIVAL = 0.01  # share of the wire: perturbed plans cannot end where an unperturbed one must
Vary = Annotated[list[str] | None, typer.Option("--vary", help="QUANTITY=AMOUNT, e.g. vertices=0.0005, friction=20%.")]


def check(
    scene: SceneName,
    out: Annotated[Path, typer.Option(help="The Zarr store of results; a summary and figures stand beside it.")],
    torque: Annotated[Path | None, typer.Option(help=f"{TORQUE} Needed unless --optimise is given.")] = None,
    vary: Vary = None,
    polygons: Annotated[Path | None, typer.Option(help="Objects to put in the scene, .npz.")] = None,
    count: Annotated[int | None, typer.Option(min=1, help="How many scenes to draw.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of the draws.")] = 0,
    arrival: Annotated[
        float,
        typer.Option(
            min=1e-9, max=1.0, help="Arrived: this near the wire's end, as a share of its length; 1e-6 for --optimise."
        ),
    ] = ARRIVAL,
    tolerance: Annotated[
        float, typer.Option(min=1e-12, max=1e-3, help="Of margins [N]; below 1e-9, all is computed as by `simulate`.")
    ] = 1e-6,
    chunk: Annotated[int, typer.Option(min=1, help="Scenes that are kept together.")] = 4096,
    optimise: Annotated[bool, typer.Option("--optimise", help="Optimise the schedule of each scene.")] = False,
    knots: Annotated[int, typer.Option(min=3, help="Torque knots a phase, with --optimise.")] = 51,
    coordinator: Annotated[str | None, typer.Option(help="HOST:PORT of the first of several processes.")] = None,
    processes: Annotated[int | None, typer.Option(min=1, help="How many processes there are.")] = None,
    process: Annotated[int | None, typer.Option(min=0, help="Which of them this is, from 0.")] = None,
) -> None:
    """Check a schedule against many variants of a scene; the same command goes on with a store it left unfinished."""
    if (polygons is None) == (count is None) or (polygons is None) != bool(vary):
        raise BadInput("check: give either --count, with --vary QUANTITY=AMOUNT, or --polygons FILE.npz")
    if torque is None and not optimise:
        raise BadInput("check: give --torque FILE, or --optimise")
    if out.suffix in BESIDE:
        raise BadInput(f"--out {out}: {out.suffix} is what stands beside the store; name the store otherwise, as .zarr")
    from wholearm_jax.files import how_many, read_polygons

    many = how_many(polygons) if polygons else count or 0
    configure(compiled="quickly" if many < MANY else "well")
    _use_all_processors()
    place = _join(coordinator, processes, process)
    try:
        import zarr  # noqa: F401
    except ModuleNotFoundError:
        raise BadInput("checking many scenes needs Zarr: pip install 'wholearm_jax[batch]'") from None
    from wholearm_jax.files import load
    from wholearm_jax.files.check_store import StoreError, fingerprint, identity
    from wholearm_jax.phases import require_motion

    loaded = load(scene)
    try:
        require_motion(loaded)
    except ValueError as error:
        raise BadInput(f"{scene}: {error}") from None
    schedule = None if optimise or torque is None else _followed(loaded, torque, place)
    if optimise and torque is not None and place.first:
        note(f"with --optimise each scene gets a schedule of its own: {torque} is not followed")
    source = read_polygons(polygons, loaded) if polygons else ensemble(loaded, vary, seed)
    total = count if count is not None else int(source.scenes.object.mass.shape[0])  # pyright: ignore
    judged = {"arrival": None, "tolerance": None} if optimise else {"arrival": arrival, "tolerance": tolerance}
    settings = judged | {"optimise": knots if optimise else None, "seed": seed}
    settings |= {"scenes": fingerprint(source), "torque": fingerprint(schedule)}
    job = _Job(source, schedule, settings, total, min(chunk, total), optimise, knots)
    try:
        store = _shared_store(out, identity(total, job.chunk, **settings), job, place)
        _fill(store, job, place)
        place.meet("filled")
        if place.first:
            told = _report(store, loaded, source, out)
            print("\n".join(told.lines))
    except StoreError as error:
        raise BadInput(str(error)) from None
    sys.exit(0)


@dataclass(frozen=True)
class _Place:
    """This process among those of a run."""

    number: int
    count: int

    @property
    def first(self) -> bool:
        return self.number == 0

    def meet(self, name: str) -> None:
        """Wait for the others."""
        if self.count > 1:
            from jax.experimental.multihost_utils import sync_global_devices

            sync_global_devices(name)


@dataclass(frozen=True)
class _Job:
    """What is to be computed."""

    source: Any
    torque: Any
    settings: dict[str, Any]
    count: int
    chunk: int
    optimise: bool
    knots: int

    @property
    def rows(self) -> int:
        """Rows of the schedule that each scene has for itself; 0 where all follow the given one."""
        scene = self.source.draw(0)
        return self.knots * len(scene.phases) if self.optimise else 0


def _followed(scene, torque: Path, place: _Place):
    """The schedule that all scenes follow."""
    from wholearm_jax.files import read_torque
    from wholearm_jax.phases import require_covered

    schedule = read_torque(torque)
    try:
        require_covered(scene, schedule)
    except ValueError as error:
        raise BadInput(f"{torque}: {error}") from None
    if place.first:
        note_limit_violations(scene, schedule, torque)
    return schedule


def ensemble(scene, amounts: list[str] | None, seed: int):
    """The ensemble that `QUANTITY=AMOUNT` arguments describe."""
    from wholearm_jax.ensembles import make_ensemble

    pairs = [text.partition("=") for text in amounts or ()]
    try:
        return make_ensemble(scene, {name.strip(): amount.strip() for name, _, amount in pairs}, seed=seed)
    except ValueError as error:
        raise BadInput(f"{error}") from None


def _use_all_processors() -> None:
    """One device for each processor, unless JAX has been told how many there are."""
    import jax

    told = "xla_force_host_platform_device_count" in os.environ.get("XLA_FLAGS", "")
    if not told and jax.config.values["jax_num_cpu_devices"] < 0:
        mine = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else range(os.cpu_count() or 1)
        with suppress(RuntimeError):  # in a process that has used JAX before, it stays at what there is
            jax.config.update("jax_num_cpu_devices", len(mine))


def _join(coordinator: str | None, processes: int | None, process: int | None) -> _Place:
    """Join the other processes of a run, if there are any."""
    given = [value is not None for value in (coordinator, processes, process)]
    slurm = int(os.environ.get("SLURM_NTASKS", "1")) > 1 and "SLURM_PROCID" in os.environ
    if not any(given) and not slurm:
        return _Place(0, 1)
    if any(given) and not all(given):
        raise BadInput("several processes: give all of --coordinator HOST:PORT, --processes and --process")
    if process is not None and processes is not None and process >= processes:
        raise BadInput(f"--process {process}: there are only {processes}, counted from 0")
    import jax

    try:
        jax.distributed.initialize(coordinator, processes, process)
    except (RuntimeError, ValueError) as error:
        raise BadInput(f"--coordinator {coordinator}: {str(error).splitlines()[0]}") from None
    return _Place(jax.process_index(), jax.process_count())


def _shared_store(out: Path, wanted, job: _Job, place: _Place):
    """The store; the first process makes it, the others open it then."""
    from wholearm_jax.files.check_store import open_store

    store = open_store(out, wanted, job.rows) if place.first else None
    place.meet("store")
    return store if store is not None else open_store(out, wanted, job.rows)


def _fill(store, job: _Job, place: _Place) -> None:
    """Compute and write the chunks that are missing and fall to this process."""
    done = store.done()
    missing = [k for k in range(place.number, store.chunks, place.count) if not done[k]]
    if not missing:
        return
    with counting_progress("{task.fields[rate]}") as progress:
        total = sum(min(store.chunk, store.count - k * store.chunk) for k in missing)
        bar, begun, written = progress.add_task("scenes", total=total, rate="compiling"), None, 0
        for number, values in _optimised(job, missing) if job.optimise else _checked(job, missing):
            store.write(number, values)
            size = len(values["status"])
            written += size if begun is not None else 0  # the first chunk's time is that of compiling
            begun = begun or time.perf_counter()
            rate = written / max(time.perf_counter() - begun, 1e-9)
            progress.update(bar, advance=size, rate=f"{rate:.0f}/s" if written else "")


def _checked(job: _Job, missing: list[int]) -> Iterator[tuple[int, dict]]:
    from wholearm_jax.ensembles import check_in_chunks

    settings = {"tolerance": job.settings["tolerance"], "arrival": job.settings["arrival"]}
    parts = check_in_chunks(job.source, job.torque, job.count, chunk=job.chunk, chunk_numbers=missing, **settings)
    for number, part in parts:
        yield number, part._asdict()


def _optimised(job: _Job, missing: list[int]) -> Iterator[tuple[int, dict]]:
    """Optimise every scene of each chunk, one scene a processor."""
    from concurrent.futures import ThreadPoolExecutor

    import jax
    import numpy as np

    from wholearm_jax.ensembles import BatchResult, from_result
    from wholearm_jax.optimisation import optimise

    def one(number):
        found = optimise(job.source.draw(number), knots=job.knots)
        schedule = np.column_stack([np.asarray(found.torque.times), np.asarray(found.torque.values)])
        return from_result(found.result), schedule

    with ThreadPoolExecutor(len(jax.local_devices())) as pool:
        for number in missing:
            rows = range(number * job.chunk, min(job.count, (number + 1) * job.chunk))
            results, schedules = zip(*pool.map(one, rows), strict=True)
            columns = [np.stack([np.asarray(value) for value in column]) for column in zip(*results, strict=True)]
            yield number, {**BatchResult(*columns)._asdict(), "torque": np.stack(schedules)}


def _report(store, scene, source, out: Path):
    """What became of all scenes, beside the store: `NAME.json`, and figures."""
    import json

    import jax
    import numpy as np

    from wholearm_jax.core import write_atomically
    from wholearm_jax.ensembles import Ensemble, most_influential, rank_correlations, summarise
    from wholearm_jax.plotting import draw_ensemble, save_figure

    told = summarise(scene, (store.read(k) for k in range(store.chunks)), store.count)
    shown, more = (), {}
    if isinstance(source, Ensemble) and source.parameters:
        shifts = np.asarray(jax.lax.map(source.draw_offsets, told.numbers, batch_size=1024))
        influence = rank_correlations(told.margins, shifts)
        shown = tuple((source.parameters[k], shifts[:, k]) for k in most_influential(source.parameters, influence))
        pairs = zip(source.parameters, influence.tolist(), strict=True)
        more = {"influence": {name: rank for name, rank in pairs if rank}}
    with writing(str(out)):
        write_atomically(out.with_suffix(".json"), json.dumps(told.as_dict() | more, indent=1) + "\n")
        save_figure(lambda: draw_ensemble(told, more.get("influence"), shown), out.parent, out.stem)
    return told
