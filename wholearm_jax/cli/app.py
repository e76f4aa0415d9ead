"""The command line: `wholearm optimise`, `simulate`, `search`, `check`, `report`, `formations`, `execute`, `scenes`.

Exit status 0 when the result is `ok`, 1 when the plan fails (its status is printed), 2 for bad input, in one line.
"""

import gc
import os
import sys
import time
from pathlib import Path
from typing import Annotated, Any

import jax
import typer

from wholearm_jax.cli.arguments import (
    BadInput,
    SceneName,
    TorqueFile,
    descent_progress,
    load_scene,
    make_output_folder,
    phase_number,
    simulate_prediction,
    traced_or_refused,
    writing,
)
from wholearm_jax.cli.check import ARRIVAL, check, ensemble
from wholearm_jax.cli.execute import execute
from wholearm_jax.cli.output import finish, write_report
from wholearm_jax.cli.robust import optimise_robustly
from wholearm_jax.core import configure, keep_programs

UsageError: Any = typer.BadParameter.__mro__[1]  # of the library beneath, which Typer has under changing names

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)

Out = Annotated[Path | None, typer.Option(help="Folder for torque.csv, trajectory.csv, summary.json and figures.")]
Changes = Annotated[
    list[str] | None,
    typer.Option("--set", help="PHASE.duration=SECONDS; PHASE is a name or a number from 0. May be repeated."),
]
Samples = Annotated[int, typer.Option(min=2, help="Rows a phase in trajectory.csv.")]


app.command()(check)


def main() -> None:
    """Run the command line."""
    # Solving small systems on several threads costs more than it gains: they wait for one another, spinning.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    os.environ.setdefault("MPLBACKEND", "agg")
    # Tracing makes many objects, nearly all to stay: looking through them for garbage took a twentieth of a first run.
    gc.set_threshold(100_000, 20, 20)
    if sys.argv[1:2] != ["check"]:  # which knows itself how many scenes there are to compile for
        configure()
    _keep_compiled()
    from wholearm_jax.files import SceneError

    try:
        sys.exit(app(sys.argv[1:] or ["--help"], standalone_mode=False) or 0)
    except typer.Abort:
        sys.exit(130)
    except UsageError as error:
        print(f"wholearm: {error.format_message()}", file=sys.stderr)
        sys.exit(2)
    except (SceneError, BadInput) as error:
        print(f"wholearm: {error}", file=sys.stderr)
        sys.exit(2)


def _keep_compiled() -> None:
    """Keep compiled programs in the user's cache folder, unless JAX has been told otherwise."""
    if jax.config.values["jax_compilation_cache_dir"] is not None or "JAX_ENABLE_COMPILATION_CACHE" in os.environ:
        return
    home = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    folder = os.path.join(home, "wholearm_jax")
    jax.config.update("jax_compilation_cache_dir", folder)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.05)
    keep_programs(Path(folder, "programs"))


@app.command()
def scenes() -> None:
    """List the bundled scenes."""
    from wholearm_jax.files import bundled, load

    for name in bundled():
        scene = load(name)
        print(f"{name}: {scene.title}; " + ", ".join(phase.name for phase in scene.phases))


@app.command()
def optimise(
    scene: SceneName,
    out: Out = None,
    set_: Changes = None,
    knots: Annotated[int, typer.Option(min=3, help="Torque knots a phase.")] = 51,
    steps: Annotated[int, typer.Option(min=1, help="Most steps of descent from each start.")] = 160,
    rate_limit: Annotated[float | None, typer.Option(min=1e-9, help="Largest torque rate [N m/s].")] = None,
    passing: Annotated[
        float | None, typer.Option(min=0.0, help="Least speed at changes of formation, over the mean speed (0.2).")
    ] = None,
    samples: Annotated[
        int | None, typer.Option(min=2, help="Rows a phase in trajectory.csv (201), or samples.")
    ] = None,
    robust: Annotated[
        list[str] | None,
        typer.Option(help="QUANTITY=AMOUNT: the best torques for --samples (64) varied scenes."),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of the varied scenes.")] = 0,
    arrival: Annotated[float, typer.Option(min=1e-9, max=1.0, help="As of `check`, for --robust.")] = ARRIVAL,
    report: Annotated[bool, typer.Option("--report", help="Also report.html, one page with an animation.")] = False,
) -> None:
    """Find the torques with the largest compressive margin, and check them by simulation."""
    if report and out is None:
        raise BadInput("--report: needs a folder to write to: add --out DIR")
    loaded = load_scene(scene, set_)
    folder = make_output_folder(out)
    if robust:
        others = (("rate-limit", rate_limit), ("passing", passing))
        unknown = [name for name, value in others if value is not None]
        if unknown:
            raise BadInput(f"--robust: knows no --{unknown[0]}")
        optimise_robustly(ensemble(loaded, robust, seed), folder, samples or 64, knots, steps, arrival, report)
    samples = samples or 201
    from wholearm_jax.optimisation import MIN_TRANSITION_SPEED, precompile_optimise
    from wholearm_jax.optimisation import optimise as find

    begun = time.perf_counter()
    precompile_optimise(loaded, knots=knots)
    traced = traced_or_refused(scene, loaded)
    with descent_progress() as progress:
        bars = [progress.add_task(p.name, total=steps, state="waiting") for p in loaded.phases]

        def show(step):
            state = f"margin {step.margin:.4f} N, apart {step.apart:.0e}"
            progress.update(bars[step.phase], completed=step.step + 1, state=state)

        progress.update(bars[0], state="compiling")
        passing = MIN_TRANSITION_SPEED if passing is None else passing
        options = {"knots": knots, "steps": steps, "rate_limit": rate_limit, "passing": passing}
        found = find(loaded, **options, callback=show, traced=traced)
        for bar, why in zip(bars, found.stopped, strict=True):
            progress.update(bar, completed=steps, state=why)
    seconds = time.perf_counter() - begun
    for phase, top, share, why in zip(
        found.result.phases, found.bounds, found.bound_fraction, found.stopped, strict=True
    ):
        held = phase.status.value == 0 and 0 < share < float("inf")  # a plan that fails may not come to the hard part
        reached = f", {100 * share:.1f} % of it reached" if held else ""
        print(f"{phase.message}; bound {float(top.value):.4g} N{reached}; stopped: {why}")
    more = {"command": "optimise", "knots": knots, "steps": len(found.history), "seconds": seconds}
    more |= {"rate_limit": rate_limit, "passing": passing, "stopped": list(found.stopped)}
    tops = tuple(float(b.value) for b in found.bounds)
    finish(found.result, folder, samples, report=report, bounds=tops, **more)


@app.command()
def simulate(
    scene: SceneName,
    torque: TorqueFile,
    out: Out = None,
    set_: Changes = None,
    samples: Samples = 201,
    tolerance: Annotated[float, typer.Option(min=1e-13, max=1e-3, help="The integrator's tolerance.")] = 1e-10,
    check_gradient: Annotated[
        bool, typer.Option("--check-gradient", help="Also the margin's derivatives: both modes against differences.")
    ] = False,
) -> None:
    """Simulate a plan under a given torque schedule."""
    loaded = load_scene(scene, set_)
    from wholearm_jax.core import wait_for
    from wholearm_jax.files import read_torque
    from wholearm_jax.optimisation import bounds
    from wholearm_jax.phases import precompile_simulate

    schedule = read_torque(torque)
    folder = make_output_folder(out)
    compiled = precompile_simulate(loaded, schedule, tolerance)
    traced = traced_or_refused(scene, loaded)
    wait_for(compiled)
    result = simulate_prediction(loaded, schedule, torque, tolerance, traced)
    _tell(result)
    if check_gradient:
        _check_gradient(loaded, schedule)
    tops = tuple(float(b.value) for b in bounds(loaded, traced=traced))
    finish(result, folder, samples, bounds=tops, command="simulate", torque=str(torque), tolerance=tolerance)


def _tell(result) -> None:
    """What became of every phase, a line each, and of every time that friction held the object."""
    for phase in result.phases:
        print(phase.message)
        for held in phase.holds:
            print(f"    {held.message}")


def _check_gradient(scene, schedule) -> None:
    """Print the margin's slopes, each three ways."""
    from rich.console import Console
    from rich.table import Table

    from wholearm_jax.phases import check_gradient

    try:
        slopes = check_gradient(scene, schedule)
    except ValueError as error:
        print(f"gradient: {error}")
        return
    table = Table(title="slope of the margin [N] along a random relative change of the inputs")
    for column in ("inputs", "tolerance", "forward mode", "reverse mode", "differences", "give or take", ""):
        table.add_column(column, justify="left" if column == "inputs" else "right", no_wrap=True)
    for one in slopes:
        numbers = (f"{x:.10g}" for x in (one.forward, one.reverse, one.differences))
        table.add_row(one.group, f"{one.tolerance:.0e}", *numbers, f"{one.uncertainty:.0e}", one.finding)
    Console(width=120).print(table)


LEGEND = """length: of the wire, in object radii; '-' and a status where none can be followed
static, bound: the best least contact force [N] with the object at rest there, and in a phase of 1 s
enter at speed: what an object that arrives at speed keeps of it; 'pulls': a contact would have to pull"""


@app.command()
def formations(
    scene: SceneName,
    after: Annotated[str | None, typer.Option(help="A phase, by name or number: list what can follow its end.")] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder for a picture of all ways: formations.png, .svg, .pdf.")
    ] = None,
) -> None:
    """List the formations of four contacts that hold at a configuration, and where their wires lead."""
    loaded = load_scene(scene, None)
    folder = make_output_folder(out)
    from rich.console import Console
    from rich.table import Table

    from wholearm_jax.phases import target_configuration
    from wholearm_jax.planning import exit_velocity, successor_formations, touching_contacts

    traced = traced_or_refused(scene, loaded)
    if after is None:
        z, z_dot = traced[0].begin, None
    else:
        row = phase_number(loaded, after)
        if row is None:
            names = ", ".join(p.name for p in loaded.phases)
            raise BadInput(f"--after {after}: no such phase; phases: {names}")
        z = target_configuration(loaded.phases[row], traced[row])
        z_dot = None if loaded.phases[row].arrive == "hold" else exit_velocity(traced[row].dynamics)
    found = successor_formations(loaded, z, z_dot)
    table = Table(title=f"touching: {', '.join(touching_contacts(loaded, z))}")
    for column in ("contacts", "toward", "leads to", "length", "static N", "bound N", "enter at speed"):
        table.add_column(column, justify="left" if column in ("contacts", "toward", "leads to") else "right")
    for way in found:
        held = f"{way.static:.3f}" if way.static > float("-inf") else "-"
        top = f"{way.bound:.3f}" if way.bound > float("-inf") else "-"
        table.add_row(" ".join(way.contacts), way.toward, way.ends, f"{way.length:.2f}", held, top, way.entering)
    Console().print(table)
    print(LEGEND)
    if folder is not None:
        from wholearm_jax.plotting import draw_successors, save_figure

        save_figure(lambda: draw_successors(loaded, z, found), folder, "formations")


@app.command()
def search(scene: SceneName, out: Out = None, samples: Samples = 201) -> None:
    """The paper's search for torques by steps of 10 %."""
    loaded = load_scene(scene, None)
    folder = make_output_folder(out)
    from wholearm_jax.core import wait_for
    from wholearm_jax.optimisation import bounds, precompile_search
    from wholearm_jax.optimisation import search_by_steps as look

    compiled = precompile_search()
    traced = traced_or_refused(scene, loaded)
    wait_for(compiled)
    try:
        found = look(loaded, traced=traced)
    except ValueError as error:
        raise BadInput(f"{scene}: {error}") from None
    _tell(found.result)
    print(f"{found.simulations} simulations in {found.seconds:.2f} s")
    tops = tuple(float(b.value) for b in bounds(found.result.scene, traced=traced))
    more = {"simulations": found.simulations, "seconds": found.seconds}
    finish(found.result, folder, samples, bounds=tops, command="search", **more)


@app.command()
def report(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="A folder that optimise, simulate or search wrote.")],
    out: Annotated[Path | None, typer.Option(help="The page to write; report.html in the folder unless given.")] = None,
) -> None:
    """Write a result folder's report: one page with an animation, plots and tables, for any browser, offline."""
    path = out or folder / "report.html"
    with writing(str(path)):
        write_report(folder, path)
    print(path)


app.command()(execute)


if __name__ == "__main__":
    main()
