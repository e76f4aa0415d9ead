"""`wholearm simulate`: a plan under a given torque schedule."""

from typing import Annotated

import typer

from wholearm_jax.cli.arguments import (
    Changes,
    OutputFolder,
    Samples,
    SceneName,
    TorqueFile,
    load_scene,
    make_output_folder,
)
from wholearm_jax.cli.output import print_phases, write_and_exit
from wholearm_jax.cli.prediction import simulate_or_exit, trace_or_exit


def simulate(
    scene: SceneName,
    torque: TorqueFile,
    out: OutputFolder = None,
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
    traced = trace_or_exit(scene, loaded)
    wait_for(compiled)
    result = simulate_or_exit(loaded, schedule, torque, tolerance, traced)
    print_phases(result)
    if check_gradient:
        _print_gradient_check(loaded, schedule)
    values = tuple(float(b.value) for b in bounds(loaded, traced=traced))
    more = {"command": "simulate", "torque": str(torque), "tolerance": tolerance}
    write_and_exit(result, folder, samples, bounds=values, **more)


def _print_gradient_check(scene, schedule) -> None:
    """Print the margin's directional derivatives by forward mode, reverse mode and finite differences."""
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
    for slope in slopes:
        numbers = (f"{x:.10g}" for x in (slope.forward, slope.reverse, slope.differences))
        table.add_row(slope.group, f"{slope.tolerance:.0e}", *numbers, f"{slope.uncertainty:.0e}", slope.finding)
    Console(width=120).print(table)
