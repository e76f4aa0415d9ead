"""`wholearm execute`: a schedule on free bodies with soft contacts."""

import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from wholearm_jax.cli.arguments import (
    BadInput,
    SceneName,
    TorqueFile,
    counting_progress,
    load_scene,
    make_output_folder,
    simulate_prediction,
    traced_or_refused,
    writing,
)


def execute(
    scene: SceneName,
    torque: TorqueFile,
    out: Annotated[Path | None, typer.Option(help="Folder for execution.json, .csv, figures and model.xml.")] = None,
    timestep: Annotated[float, typer.Option(min=1e-6, max=1e-2, help="Time step [s].")] = 2e-4,
    position: Annotated[float, typer.Option(min=0.0, help="Success: this near the predicted end [m].")] = 5e-4,
    angle: Annotated[float, typer.Option(min=0.0, help="Success: this near the predicted angle [rad].")] = 0.01,
    video: Annotated[bool, typer.Option("--video", help="Also execution.gif and a strip of its frames.")] = False,
    perturb: Annotated[int, typer.Option(min=0, help="Executions of a perturbed object.")] = 0,
    seed: Annotated[int, typer.Option(min=0, help="Of the perturbations.")] = 0,
    friction: Annotated[str, typer.Option(help="Perturbation of friction coefficients, e.g. 10%.")] = "10%",
    mass: Annotated[str, typer.Option(help="Perturbation of the mass, e.g. 5%.")] = "5%",
    geometry: Annotated[float, typer.Option(min=0.0, help="Perturbation of the vertices [m].")] = 5e-4,
    start: Annotated[float, typer.Option(min=0.0, help="Perturbation of the start [m].")] = 5e-4,
) -> None:
    """Execute a torque schedule open loop on free bodies with soft contacts, in MuJoCo."""
    if video and out is None:
        raise BadInput("--video: needs a folder to write to: add --out DIR")
    shares = _share("--friction", friction), _share("--mass", mass)
    loaded = load_scene(scene, None)
    try:
        from wholearm_jax.execution import Amounts, ExecutionOutcome, Tolerance, require_objects, require_wires
        from wholearm_jax.execution import execute as drive
        from wholearm_jax.execution import run_trials as drive_perturbed
    except ModuleNotFoundError as error:
        if error.name not in ("mujoco", "joblib"):
            raise
        raise BadInput("execution needs MuJoCo: pip install 'wholearm_jax[mujoco]'") from None
    from wholearm_jax.files import read_torque

    schedule, amounts = read_torque(torque), Amounts(*shares, geometry, start)
    if perturb:
        try:
            require_objects(loaded, amounts)
        except ValueError as error:
            raise BadInput(f"--{error}") from None
    folder = make_output_folder(out)
    prediction = simulate_prediction(loaded, schedule, torque, 1e-10, traced_or_refused(scene, loaded))
    within = Tolerance(position, angle)
    print(f"predicted: {prediction.message}")
    try:
        require_wires(prediction)
    except ValueError:
        sys.exit(1)  # no wire, no end to arrive at; the line above says why
    done = drive(prediction, timestep=timestep, tolerance=within)
    for contact, made, expected, executed in done.events:
        times = " predicted, ".join("never" if t is None else f"{t:.4f} s" for t in (expected, executed))
        print(f"{contact} {'made' if made else 'opened'}: {times} executed")
    many = None
    if perturb:
        with _progress(perturb) as told:
            settings = {"seed": seed, "timestep": timestep, "tolerance": within, "callback": told}
            many = drive_perturbed(prediction, perturb, amounts, **settings)
        print(many.message)
    if folder is not None:
        _write_execution(done, many, torque, folder, video)
    print(f"executed: {done.message}" + (f" -> {folder}" if folder else ""))
    sys.exit(0 if done.ending is ExecutionOutcome.OK else 1)


def _share(option: str, text: str) -> float:
    """`10%` or `0.1` -> 0.1."""
    try:
        share = float(text.removesuffix("%")) / (100 if text.endswith("%") else 1)
    except ValueError:
        share = -1.0
    if not 0 <= share < 1:
        raise BadInput(f"{option} {text}: write a share between 0 and 1, e.g. 10% or 0.1")
    return share


@contextmanager
def _progress(count: int) -> Iterator[Callable]:
    """A bar on the terminal while perturbed executions run, to be called with each that is done."""
    from wholearm_jax.execution import ExecutionOutcome

    with counting_progress("{task.fields[succeed]} succeed") as progress:
        bar, succeed = progress.add_task("perturbed executions", total=count, succeed=0), 0

        def told(run) -> None:
            nonlocal succeed
            succeed += run.ending is ExecutionOutcome.OK
            progress.update(bar, advance=1, succeed=succeed)

        yield told


def _write_execution(done, many, torque: Path, folder: Path, video: bool) -> None:
    """Write an execution's files."""
    from wholearm_jax.core import write_atomically
    from wholearm_jax.files import discard_execution, execution_summary, write_execution, write_summary

    with writing(f"--out {folder}"):
        discard_execution(folder)
        write_summary(execution_summary(done, many, torque=str(torque)), folder / "execution.json")
        write_execution(done, folder / "execution.csv")
        write_atomically(folder / "model.xml", done.model_xml)
        _draw_execution(done, folder, video)


def _draw_execution(done, folder: Path, video: bool) -> None:
    import matplotlib.pyplot as plt

    from wholearm_jax.core import write_atomically
    from wholearm_jax.plotting import animate, draw_execution, draw_execution_strip, save_figure

    save_figure(lambda: draw_execution(done), folder, "execution")
    if video:
        save_figure(lambda: draw_execution_strip(done), folder, "frames")
        with tempfile.TemporaryDirectory() as elsewhere:
            drawn = Path(elsewhere, "execution.gif")
            animate(done).save(drawn, writer="pillow")  # which needs no further program
            write_atomically(folder / "execution.gif", drawn.read_bytes())
        plt.close("all")
