"""`wholearm formations`: the contact formations that can follow a configuration, or begin a plan."""

import math
from pathlib import Path
from typing import Annotated, Any

import typer

from wholearm_jax.cli.arguments import (
    AsJson,
    BadInput,
    SceneName,
    make_output_folder,
    note,
    phase_number,
    refuse_unwritable,
)
from wholearm_jax.cli.prediction import trace_or_exit
from wholearm_jax.cli.tables import Column, print_json, print_table

NEAR_TOL = 0.25  # gap at a start that is given roughly, in object radii, below which a contact may be meant
MAX_NEAR = 4  # such contacts of a link: the formations of four contacts grow with the fourth power of their number
LEGEND = """ends at, turn: the object's position and angle at the end, and by how much it turns
length: of the path, in object radii; '-' and a status where none can be followed
static, bound: the best least contact force [N] with the object at rest there, and in a phase of 1 s
enter at speed: what an object that arrives at speed keeps of it; 'pulls': a contact would have to pull"""
TEXT_COLUMNS = ("contacts", "toward", "leads to")
BEGIN_COLUMN = "begins at x, y mm"
NUMBER_COLUMNS = ("ends at x, y mm", "phi deg", "turn deg", "length", "static N", "bound N", "enter at speed")


def formations(
    scene: SceneName,
    after: Annotated[str | None, typer.Option(help="A phase, by name or number: list what can follow its end.")] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder for a picture of all paths: formations.png, .svg, .pdf.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """List the formations that hold at a configuration.

    Contacts slide and roll; it is said where each path leads. The configuration is the end of a phase, or the start;
    in a scene without phases, what can begin near its start.
    """
    from wholearm_jax.files import load_start
    from wholearm_jax.phases import describe_overlaps
    from wholearm_jax.planning import flush_sides, successor_formations, touching_contacts

    loaded = load_start(scene)
    folder = make_output_folder(out)
    if loaded.phases or after is not None:
        z, z_dot = _configuration(loaded, trace_or_exit(scene, loaded), after)
        touching, title = touching_contacts(loaded, z), "touching"
        successors = successor_formations(loaded, z, z_dot, rolling=True)
    else:
        z, touching, title = loaded.start, _near_contacts(loaded), "touching, or near"
        successors = successor_formations(loaded, z, rolling=True, touching=touching)
    flush = flush_sides(loaded, touching)
    overlaps = describe_overlaps(loaded, z) if loaded.phases or not successors else ()  # a rough start is projected
    for overlap in overlaps:
        note(f"{scene}: {overlap}: no phase can begin here")
    if as_json:
        rows = [_json_row(successor) for successor in successors]
        print_json({"touching": touching, "flush": flush, "overlaps": overlaps, "formations": rows})
    else:
        begins = () if loaded.phases else (BEGIN_COLUMN,)
        columns = [*map(Column, TEXT_COLUMNS), *(Column(name, True) for name in (*begins, *NUMBER_COLUMNS))]
        rows = [_table_row(successor, bool(begins)) for successor in successors]
        lines = [f"{title}: {', '.join(touching) or 'nothing'}"]
        lines += [f"flush: {', '.join(flush)} (a formation holds one of its vertices, or both)"] if flush else []
        print_table(columns, rows, "\n".join(lines), LEGEND)
    if folder is not None:
        from wholearm_jax.files import FileSet, replace_files
        from wholearm_jax.plotting import plot_successors, save_figure

        files = FileSet(None, (), ("formations",))
        with refuse_unwritable(f"--out {folder}"), replace_files(folder, files) as scratch:
            save_figure(lambda: plot_successors(loaded, z, successors), scratch, "formations")


def _near_contacts(scene) -> list[str]:
    """Return the contacts that may be meant at a start that is given roughly: of each link the few that are nearest."""
    from wholearm_jax.model import LINKS
    from wholearm_jax.planning import touching_contacts

    order = touching_contacts(scene, scene.start, NEAR_TOL)
    near = {link: [name for name in order if name.startswith(f"{link}:")] for link in LINKS}
    tolerance = NEAR_TOL
    while tolerance > 1e-6 and any(len(contacts) > MAX_NEAR for contacts in near.values()):  # as of a smooth outline
        tolerance *= 0.8
        names = touching_contacts(scene, scene.start, tolerance)
        for link, contacts in near.items():
            fewer = [name for name in contacts if name in names]
            if len(contacts) > MAX_NEAR and fewer:
                near[link] = fewer
    nearest = {name for contacts in near.values() for name in contacts[:MAX_NEAR]}  # of equally near ones, the first
    return [name for name in order if name in nearest]


def _configuration(scene, traced, after: str | None):
    """Return configuration and exit velocity (None at rest): at the end of phase `after`, else at the plan's start."""
    from wholearm_jax.model import Arrival
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


def _json_row(successor) -> dict[str, Any]:
    """Return a successor in SI units, with its turn in degrees."""
    import numpy as np

    from wholearm_jax.model import COORDINATES

    begin, end = np.asarray(successor.traced.begin), np.asarray(successor.end)
    return {
        "contacts": successor.contacts,
        "toward": successor.toward,
        "status": successor.status.label,
        "ends": successor.ends,
        "begin": dict(zip(COORDINATES, begin.tolist(), strict=True)),
        "end": dict(zip(COORDINATES, end.tolist(), strict=True)),
        "displacement": (end - begin)[:2].tolist(),
        "turn_degrees": float(np.degrees(end[2] - begin[2])),
        "length": successor.length,
        "static": successor.static,
        "bound": successor.bound,
        "entering": successor.entering,
    }


def _table_row(successor, with_begin: bool) -> tuple[str, ...]:
    """Return a successor's cells; dashes where its path could not be traced."""
    row, is_traced = _json_row(successor), successor.status.value == 0
    begin, end = (f"{1e3 * row[k]['x']:.1f}, {1e3 * row[k]['y']:.1f}" for k in ("begin", "end"))
    angles = math.degrees(row["end"]["phi"]), row["turn_degrees"]
    pose = (end, *(f"{round(angle, 1) + 0.0:.1f}" for angle in angles)) if is_traced else ("-",) * 3
    forces = (f"{x:.3f}" if x > float("-inf") else "-" for x in (successor.static, successor.bound))
    words = " ".join(successor.contacts), successor.toward, successor.ends
    numbers = (*pose, f"{successor.length:.2f}", *forces, successor.entering)
    return (*words, begin, *numbers) if with_begin else (*words, *numbers)
