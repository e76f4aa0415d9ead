"""`wholearm simulate`: a plan under a given torque schedule."""

from dataclasses import asdict
from typing import Annotated

import typer

from wholearm_jax.cli.arguments import (
    AsJson,
    Changes,
    OutputFolder,
    Samples,
    SceneName,
    TorqueFile,
    load_scene,
    make_output_folder,
)
from wholearm_jax.cli.output import print_phases, write_and_exit
from wholearm_jax.cli.prediction import refuse_short, simulate_or_exit, trace_or_exit


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
    as_json: AsJson = False,
) -> None:
    """Simulate a plan under a given torque schedule."""
    loaded = load_scene(scene, set_)
    from wholearm_jax.core import wait_for
    from wholearm_jax.files import read_torque
    from wholearm_jax.optimisation import bounds, certified_bounds, explain
    from wholearm_jax.phases import precompile_simulate

    schedule = read_torque(torque)
    refuse_short(loaded, schedule, torque)
    folder = make_output_folder(out)
    compiled = precompile_simulate(loaded, schedule, tolerance)
    traced = trace_or_exit(scene, loaded)
    wait_for(compiled)
    pointwise = bounds(loaded, traced=traced)
    result = explain(simulate_or_exit(loaded, schedule, torque, tolerance, traced), margin_bounds=pointwise)
    if not as_json:
        print_phases(result)
    gradient = _check_gradient(loaded, schedule, as_json) if check_gradient else {}
    values = tuple(float(b.value) for b in certified_bounds(loaded, traced=traced, pointwise=pointwise))
    more = {"command": "simulate", "torque": str(torque), "tolerance": tolerance} | gradient
    write_and_exit(result, folder, samples, as_json, bounds=values, **more)


def _check_gradient(scene, schedule, as_json: bool) -> dict:
    """Compare the margin's directional derivatives: forward mode, reverse mode, differences; print them as a table."""
    from wholearm_jax.cli.tables import Column, print_table
    from wholearm_jax.phases import check_gradient

    try:
        slopes = check_gradient(scene, schedule)
    except ValueError as error:
        if not as_json:
            print(f"gradient: {error}")
        return {"gradient": str(error)}
    if not as_json:
        names = ("tolerance", "forward mode", "reverse mode", "differences", "give or take")
        rows = [
            (
                slope.group,
                f"{slope.tolerance:.0e}",
                *(f"{x:.10g}" for x in (slope.forward, slope.reverse, slope.differences)),
                f"{slope.uncertainty:.0e}",
                slope.finding,
            )
            for slope in slopes
        ]
        title = "slope of the margin [N] along a random relative change of the inputs"
        print_table([Column("inputs"), *(Column(name, True) for name in names), Column("", True)], rows, title)
    return {"gradient": [asdict(slope) | {"finding": slope.finding} for slope in slopes]}
