"""`wholearm execute`: a torque schedule on free bodies with soft contacts."""

import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from wholearm_jax.cli.arguments import (
    TORQUE_HELP,
    AsJson,
    BadInput,
    SceneName,
    load_scene,
    make_output_folder,
    note,
    refuse_unwritable,
)
from wholearm_jax.cli.interruption import quiet_workers
from wholearm_jax.cli.output import may_replace, note_hand_overs
from wholearm_jax.cli.prediction import read_controller_of, simulate_or_exit, trace_or_exit
from wholearm_jax.cli.progress import count_progress
from wholearm_jax.cli.tables import print_json

PUSH_HELP = "An impulse [N s; N m s] during 10 ms, from a time [s] on, e.g. 'x=0.002@0.4'. May be repeated."


def execute(
    scene: SceneName,
    torque: Annotated[Path | None, typer.Option("--torque", help=TORQUE_HELP)] = None,
    controller: Annotated[Path | None, typer.Option(help="A controller.json: execute in closed loop.")] = None,
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
    push: Annotated[list[str] | None, typer.Option(help=PUSH_HELP)] = None,
    rate: Annotated[float, typer.Option(min=1.0, help="Sampling rate of the controller [Hz].")] = 1000.0,
    delay: Annotated[float, typer.Option(min=0.0, help="From measurement to torque [s].")] = 1e-3,
    counts: Annotated[int, typer.Option(min=0, help="Encoder counts a turn (0: exact).")] = 4096,
    torque_noise: Annotated[float, typer.Option(min=0.0, help="Standard deviation, a share of the torque.")] = 0.01,
    as_json: AsJson = False,
) -> None:
    """Execute a torque schedule, or a controller, in MuJoCo.

    A schedule is executed open loop. The bodies are free, and their contacts soft.
    """
    if (torque is None) == (controller is None):
        raise BadInput("give either --torque FILE or --controller FILE")
    if video and out is None:
        raise BadInput("--video: needs a folder to write to: add --out DIR")
    fractions = _fraction("--friction", friction), _fraction("--mass", mass)
    loaded = load_scene(scene)
    try:
        from wholearm_jax.execution import (
            Amounts,
            ExecutionOutcome,
            Hardware,
            Tolerance,
            require_objects,
            require_paths,
        )
        from wholearm_jax.execution import execute as rollout
    except ModuleNotFoundError as error:
        if error.name not in ("mujoco", "joblib"):
            raise
        raise BadInput("execution needs MuJoCo: pip install 'wholearm_jax[mujoco]'") from None
    from wholearm_jax.files import EXECUTION_FILES, execution_summary

    amounts, hardware = Amounts(*fractions, geometry, start), Hardware(rate, delay, counts, torque_noise)
    if perturb:
        try:
            require_objects(loaded, amounts)
        except ValueError as error:
            raise BadInput(f"--{error}") from None
    pushes = tuple(_read_push(text) for text in push or ())
    folder = make_output_folder(out)
    prediction, law = _predict(scene, loaded, torque, controller)
    if not as_json and law is None:
        print(f"predicted: {prediction.message}")
    try:
        require_paths(prediction)
    except ValueError:  # without a path there is no end to arrive at; the prediction says why
        if as_json:
            print_json({"prediction": {"status": prediction.status.label, "message": prediction.message}})
        sys.exit(1)
    settings = {"timestep": timestep, "tolerance": Tolerance(position, angle), "pushes": pushes}
    settings |= {"controller": law, "hardware": hardware}
    execution = rollout(prediction, seed=seed, **settings)
    _note_late_pushes(push or [], pushes, float(execution.course.time[-1]))
    trials = _run_trials(prediction, perturb, amounts, seed=seed, **settings) if perturb else None
    driven_by = _torque_source(torque, controller, law, hardware)
    content = execution_summary(execution, trials, **driven_by, **_as_data(pushes))
    ok = execution.ending is ExecutionOutcome.OK
    folder = folder if folder and may_replace(folder, EXECUTION_FILES, ok) else None
    if folder is not None:
        _write_execution(execution, content, folder, video)
    if as_json:
        print_json(content)
    else:
        _print_execution(execution, trials, folder)
    if law is None:
        _note_open_loop(prediction, execution)
    else:
        _note_lost_contacts(law, hardware, trials)
    sys.exit(0 if ok else 1)


def _torque_source(torque: Path | None, controller: Path | None, law, hardware) -> dict[str, Any]:
    """Return what execution.json says about where torques come from: a schedule, or a controller and its hardware."""
    if law is None:
        return {"torque": str(torque)}
    least = {"least_force": law.margin}
    return {"prediction": least, "controller": str(controller), "hardware": hardware._asdict()}


def _as_data(pushes) -> dict[str, Any]:
    """Return what execution.json says about pushes: nothing where there are none."""
    return {"pushes": [dict(one._asdict(), impulse=one.impulse.tolist()) for one in pushes]} if pushes else {}


def _note_late_pushes(texts: list[str], pushes, end: float) -> None:
    """Say which pushes come after an execution's end [s]."""
    for text, one in zip(texts, pushes, strict=True):
        if one.time >= end:
            note(f"--push {text}: the execution ends at {end:.4g} s, before it")


def _predict(name: str, scene, torque: Path | None, controller: Path | None):
    """Return the prediction to compare with, and the controller.

    That of a controller is the plan under the quasi-static torques, of which the paths alone count.
    """
    from wholearm_jax.files import read_torque
    from wholearm_jax.optimisation import quasistatic

    if torque is not None:
        return simulate_or_exit(scene, read_torque(torque), torque, 1e-10, trace_or_exit(name, scene)), None
    assert controller is not None
    law = read_controller_of(scene, controller)
    traced = trace_or_exit(name, scene)
    return simulate_or_exit(scene, quasistatic(scene, traced=traced), controller, 1e-10, traced), law


def _fraction(option: str, text: str) -> float:
    """Read `10%` or `0.1` as 0.1."""
    try:
        fraction = float(text.removesuffix("%")) / (100 if text.endswith("%") else 1)
    except ValueError:
        fraction = -1.0
    if not 0 <= fraction < 1:
        raise BadInput(f"{option} {text}: write a share between 0 and 1, e.g. 10% or 0.1")
    return fraction


def _read_push(text: str):
    """Read `x=0.002@0.4`, or impulses along several coordinates, `x=0.002,y=-0.001@0.4`."""
    from wholearm_jax.execution import push

    impulses, _, time = text.rpartition("@")
    try:
        pairs = [part.partition("=") for part in impulses.split(",")]
        return push(float(time), **{name.strip(): float(value) for name, _, value in pairs})
    except ValueError as error:
        why = f": {error}" if str(error).startswith("push") else ""
        raise BadInput(f"--push {text}: write COORDINATE=IMPULSE@TIME, e.g. 'x=0.002@0.4'{why}") from None


def _print_execution(execution, trials, folder: Path | None) -> None:
    """Print when each contact was made or opened, predicted and executed, how many trials succeed, and the outcome."""
    for contact, made, expected, executed in execution.events:
        times = " predicted, ".join("never" if t is None else f"{t:.4f} s" for t in (expected, executed))
        print(f"{contact} {'made' if made else 'opened'}: {times} executed")
    if trials is not None:
        print(trials.message)
    print(f"executed: {execution.message}" + (f" -> {folder}" if folder else ""))


def _note_open_loop(prediction, execution) -> None:
    """Where the object goes astray without a law, say how exact torques must be, and what helps.

    Contacts are lost, and links meet, for that reason where torques must be more exact than a motor's.
    """
    from wholearm_jax.execution import ExecutionOutcome
    from wholearm_jax.phases import MOTOR_ERROR, torque_accuracy

    if execution.ending in (ExecutionOutcome.OK, ExecutionOutcome.DIVERGED):
        return
    note_hand_overs(prediction)
    accuracy = min((one for one in torque_accuracy(prediction) if one > 0), default=float("inf"))  # NaN left out
    if execution.ending is not ExecutionOutcome.ASTRAY and accuracy >= MOTOR_ERROR:
        return
    must = f", and torques would have to be right to {100 * accuracy:.2g} %" if accuracy < 1 else ""
    note(
        f"open loop nothing corrects the object{must}; a law does: wholearm optimise SCENE --feedback --out DIR,"
        " then execute it with --controller DIR/controller.json; --timestep"
        f" {execution.timestep / 4:g} says whether only this simulation's steps are too long"
    )


def _note_lost_contacts(law, hardware, trials) -> None:
    """Where perturbed objects lose contacts that their law keeps, say how to tell whether the encoders do it."""
    if trials is None or law.margin <= 0 or hardware.counts == 0:
        return
    lost = sum(run.least_force <= 0 for run in trials.runs)
    if not lost:
        return
    rates = ", ".join(f"{name}={getattr(law, name) / 2:.3g}" for name in ("stiffness", "integral", "observer"))
    note(
        f"a contact opened on the way in {lost} of {len(trials.runs)}, though the law's least force is"
        f" {law.margin:.3g} N: an encoder's steps may do so. --counts {4 * hardware.counts} tells; if it is they, a law"
        f" with lower rates follows them less: wa.feedback(scene, torque, {rates})"
    )


def _run_trials(prediction, count: int, amounts, **settings):
    """Execute perturbed objects, with a progress bar."""
    from wholearm_jax.execution import ExecutionOutcome, run_trials

    with quiet_workers(), count_progress("{task.fields[succeed]} succeed") as progress:
        bar, succeed = progress.add_task("perturbed executions", total=count, succeed=0), 0

        def show(trial) -> None:
            nonlocal succeed
            succeed += trial.ending is ExecutionOutcome.OK
            progress.update(bar, advance=1, succeed=succeed)

        return run_trials(prediction, count, amounts, callback=show, **settings)


def _write_execution(execution, content: dict, folder: Path, video: bool) -> None:
    """Write an execution's files."""
    from wholearm_jax.core import write_atomically
    from wholearm_jax.files import EXECUTION_FILES, replace_files, write_execution, write_summary

    with refuse_unwritable(f"--out {folder}"), replace_files(folder, EXECUTION_FILES) as scratch:
        write_summary(content, scratch / "execution.json")
        write_execution(execution, scratch / "execution.csv")
        write_atomically(scratch / "model.xml", execution.model_xml)
        _write_figures(execution, scratch, video)


def _write_figures(execution, folder: Path, video: bool) -> None:
    """Write the figure of an execution and, with `video`, its strip of poses and animation."""
    import matplotlib.pyplot as plt

    from wholearm_jax.plotting import animate, plot_execution, plot_execution_strip, save_figure

    save_figure(lambda: plot_execution(execution), folder, "execution")
    if video:
        save_figure(lambda: plot_execution_strip(execution), folder, "frames")
        animate(execution).save(folder / "execution.gif", writer="pillow")  # pillow needs no further program
        plt.close("all")
