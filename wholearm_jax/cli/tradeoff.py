"""`wholearm tradeoff`: margin against duration."""

from pathlib import Path
from typing import Annotated

import typer

from wholearm_jax.cli.arguments import (
    AsJson,
    BadInput,
    Changes,
    SceneName,
    load_scene,
    make_output_folder,
    refuse_unwritable,
)
from wholearm_jax.cli.prediction import trace_or_exit
from wholearm_jax.cli.tables import Column, print_json, print_table

TRADEOFF_LEGEND = """margin: least force of every contact, at every time
a phase: the shortest time in which any torque within limits moves the object with that margin"""


def tradeoff(
    scene: SceneName,
    out: Annotated[Path | None, typer.Option(help="Folder for a figure: tradeoff.png, .svg, .pdf.")] = None,
    changes: Changes = None,
    as_json: AsJson = False,
) -> None:
    """Print the shortest durations for margins up to the largest."""
    loaded = load_scene(scene, changes)
    folder = make_output_folder(out)
    from wholearm_jax.optimisation import tradeoff as margin_duration_tradeoff

    traced = trace_or_exit(scene, loaded)
    try:
        curve = margin_duration_tradeoff(loaded, traced=traced)
    except ValueError as error:
        raise BadInput(f"{scene}: {error}") from None
    names = [loaded.phases[k].name for k in curve.phases]
    if as_json:
        durations = [dict(zip(names, row, strict=True)) for row in curve.durations.tolist()]
        rows = zip(curve.margins.tolist(), durations, curve.total.tolist(), strict=True)
        content = [{"margin": margin, "durations": times, "total": total} for margin, times, total in rows]
        print_json({"largest": dict(zip(names, curve.largest.tolist(), strict=True)), "tradeoff": content})
    else:
        columns = [Column(name, True) for name in ("margin N", *(f"{name} s" for name in names), "total s")]
        table = zip(curve.margins, curve.durations, curve.total, strict=True)
        cells = [[f"{margin:.4f}", *(f"{t:.4f}" for t in times), f"{total:.4f}"] for margin, times, total in table]
        print_table(columns, cells, "shortest durations", TRADEOFF_LEGEND)
    if folder is not None:
        from wholearm_jax.files import FileSet, replace_files
        from wholearm_jax.plotting import plot_tradeoff, save_figure

        with refuse_unwritable(f"--out {folder}"), replace_files(folder, FileSet(None, (), ("tradeoff",))) as scratch:
            save_figure(lambda: plot_tradeoff(curve, loaded), scratch, "tradeoff")
