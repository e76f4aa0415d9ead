"""`wholearm formations`: the contact formations that can follow a configuration."""

from pathlib import Path
from typing import Annotated

import typer

from wholearm_jax.cli.arguments import BadInput, SceneName, load_scene, make_output_folder, phase_number
from wholearm_jax.cli.prediction import trace_or_exit
from wholearm_jax.model import Arrival

LEGEND = """length: of the wire, in object radii; '-' and a status where none can be followed
static, bound: the best least contact force [N] with the object at rest there, and in a phase of 1 s
enter at speed: what an object that arrives at speed keeps of it; 'pulls': a contact would have to pull"""


def formations(
    scene: SceneName,
    after: Annotated[str | None, typer.Option(help="A phase, by name or number: list what can follow its end.")] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder for a picture of all ways: formations.png, .svg, .pdf.")
    ] = None,
) -> None:
    """List the formations of four contacts that hold at a configuration, and where their wires lead."""
    loaded = load_scene(scene)
    folder = make_output_folder(out)
    from wholearm_jax.planning import successor_formations

    z, z_dot = _configuration(loaded, trace_or_exit(scene, loaded), after)
    successors = successor_formations(loaded, z, z_dot)
    _print_table(loaded, z, successors)
    if folder is not None:
        from wholearm_jax.plotting import plot_successors, save_figure

        save_figure(lambda: plot_successors(loaded, z, successors), folder, "formations")


def _configuration(scene, traced, after: str | None):
    """Return configuration and exit velocity (None at rest): at the end of phase `after`, else at the plan's start."""
    from wholearm_jax.phases import target_configuration
    from wholearm_jax.planning import exit_velocity

    if after is None:
        return traced[0].begin, None
    row = phase_number(scene, after)
    if row is None:
        names = ", ".join(p.name for p in scene.phases)
        raise BadInput(f"--after {after}: no such phase; phases: {names}")
    z = target_configuration(scene.phases[row], traced[row])
    return z, None if scene.phases[row].arrive is Arrival.HOLD else exit_velocity(traced[row].dynamics)


def _print_table(scene, z, successors) -> None:
    """Print a row for each successor, and the columns' meaning."""
    from rich.console import Console
    from rich.table import Table

    from wholearm_jax.planning import touching_contacts

    table = Table(title=f"touching: {', '.join(touching_contacts(scene, z))}")
    for column in ("contacts", "toward", "leads to", "length", "static N", "bound N", "enter at speed"):
        table.add_column(column, justify="left" if column in ("contacts", "toward", "leads to") else "right")
    for successor in successors:
        forces = (f"{x:.3f}" if x > float("-inf") else "-" for x in (successor.static, successor.bound))
        words = " ".join(successor.contacts), successor.toward, successor.ends
        table.add_row(*words, f"{successor.length:.2f}", *forces, successor.entering)
    Console().print(table)
    print(LEGEND)
