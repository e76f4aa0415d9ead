"""`wholearm scene`: a scene file from a drawing."""

from pathlib import Path
from typing import Annotated

import typer

from wholearm_jax.cli.arguments import AsJson, BadInput, note, refuse_unwritable
from wholearm_jax.cli.tables import Column, print_json, print_table

MANY_VERTICES, COARSER, FEWER = 12, 10, 0.7  # of an outline; how much coarser a tolerance, for which share of vertices
UNIT_HELP = "Of the drawing's lengths: mm, cm, m, in, px ...; its own unless given."


def scene(
    drawing: Annotated[Path, typer.Argument(help="A drawing: .dxf, .svg, .csv (points) or .stl (its flat section).")],
    unit: Annotated[str | None, typer.Option(help=UNIT_HELP)] = None,
    tolerance: Annotated[
        float, typer.Option(help="Distance of the outline from the drawing at most [mm], as where curves become edges.")
    ] = 0.05,
    mass: Annotated[float | None, typer.Option(help="[kg]; by density unless given.")] = None,
    density: Annotated[
        float | None, typer.Option(help="Mass over area [kg/m^2]; 40, as of 15 mm of aluminium, unless given.")
    ] = None,
    friction: Annotated[
        str, typer.Option(help="Coulomb's coefficient of all contacts, or palm=0.5,finger1=0.1,finger2=0.1.")
    ] = "0.1",
    on: Annotated[
        str | None, typer.Option(help="Edge to begin on: e0 joins the first two vertices; the steadiest unless given.")
    ] = None,
    fill_holes: Annotated[
        bool, typer.Option("--fill-holes", help="Accept holes: nothing touches them, but they take from mass.")
    ] = False,
    outline: Annotated[int | None, typer.Option(help="Which of several outlines, from 1.")] = None,
    out: Annotated[
        Path | None, typer.Option(help="Scene file to write; the drawing's name with .toml unless given.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Write a scene from the drawing of a part.

    The part rests on an edge, in a hand that fits it.
    """
    from wholearm_jax.core import write_atomically
    from wholearm_jax.files import choose_outline, describe_choice, outline_tables, read_outlines, scene_text

    outlines = read_outlines(drawing, unit=unit, tolerance=1e-3 * tolerance)
    if outline is None and len(outlines) > 1:
        _list(outlines, as_json)
        raise BadInput(f"{drawing}: {len(outlines)} outlines; choose one with --outline 1 to {len(outlines)}")
    chosen = choose_outline(outlines, outline, fill_holes=fill_holes)
    tables, choice = outline_tables(chosen, mass=mass, density=density, friction=_read_friction(friction), on=on)
    lines = [f"{drawing.name}: {_describe(chosen)}", *describe_choice(choice)]
    given = "as given" if mass is not None else f"{density or 40.0:g} kg/m^2"
    lines.append(f"mass: {tables['object']['mass']:.4g} kg ({given}); friction: {friction}")
    path = out or Path(drawing.with_suffix(".toml").name)
    if out is None and path.exists():
        raise BadInput(f"{path}: there already; name another file with --out, or this one to replace it")
    with refuse_unwritable(f"--out {path}"):
        write_atomically(path, scene_text(tables, lines))
    if chosen.skipped:
        note(f"{drawing}: passed over: {', '.join(chosen.skipped)}")
    _note_many_vertices(drawing, unit, tolerance, len(chosen.vertices), outline)
    if as_json:
        print_json({"scene": str(path)} | tables)
        return
    print("\n".join(lines))
    span = 2 * tables["hand"]["finger1"]["joint"][0]
    print(f"-> {path}; go on with: wholearm plan {path} --by x={-(span - choice.width) / 4:.1g}")


def _note_many_vertices(drawing: Path, unit: str | None, tolerance: float, count: int, outline: int | None) -> None:
    """Say how few vertices would do with a coarser tolerance, where curves make for many."""
    from wholearm_jax.core import SceneError
    from wholearm_jax.files import read_outlines

    if count <= MANY_VERTICES:
        return
    coarser = COARSER * tolerance
    try:
        fewer = len(read_outlines(drawing, unit=unit, tolerance=1e-3 * coarser)[(outline or 1) - 1].vertices)
    except (SceneError, IndexError):  # nothing of the part would be left
        return
    if fewer < FEWER * count:
        note(
            f"{count} vertices, {fewer} with --tolerance {coarser:g}: "
            "a plan passes a curve vertex by vertex, each in a phase of its own"
        )


def _read_friction(text: str) -> float | dict[str, float]:
    """Read `0.1`, or `palm=0.5,finger1=0.1,finger2=0.1`."""
    try:
        if "=" not in text:
            return float(text)
        return {name.strip(): float(value) for name, value in (part.split("=") for part in text.split(","))}
    except ValueError:
        raise BadInput(f"--friction {text}: write a number, or palm=0.5,finger1=0.1,finger2=0.1") from None


def _describe(outline) -> str:
    """Say what an outline is."""
    from wholearm_jax.files import describe_outline

    holes = f", {len(outline.holes)} filled hole{'s' * (len(outline.holes) > 1)}" if outline.holes else ""
    return f"{describe_outline(outline)}, {len(outline.vertices)} vertices{holes}"


def _list(outlines, as_json: bool) -> None:
    """List the outlines of a drawing."""
    rows = [
        tuple(f"{value:.4g}" for value in (k, 1e6 * one.area, *(1e3 * size for size in one.size), *_counts(one)))
        for k, one in enumerate(outlines, 1)
    ]
    names = ("outline", "area mm^2", "width mm", "height mm", "vertices", "holes")
    if as_json:
        print_json({"outlines": [dict(zip(names, map(float, row), strict=True)) for row in rows]})
    else:
        print_table([Column(name, True) for name in names], rows)


def _counts(outline) -> tuple[int, int]:
    """Return how many vertices and holes an outline has."""
    return len(outline.vertices), len(outline.holes)
