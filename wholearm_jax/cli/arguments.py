"""Arguments that several commands share: their options, how their values are read, and the error for unusable ones.

Slow imports stay inside functions: a command that does not need them starts at once.
"""

import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from wholearm_jax.core import BadInput, as_device_array

ARRIVAL_FRACTION = 0.01  # of a path's length: perturbed plans cannot end where an unperturbed one must
TORQUE_HELP = "Torque schedule, CSV with the header t,tau1,tau2."
SET_HELP = (
    "PHASE.duration=SECONDS, PHASE.until.COORDINATE=VALUE or start.COORDINATE=VALUE; PHASE is a name or a number from "
    '0, VALUE in metres, radians, "-20 mm" or "-40 deg". May be repeated.'
)

LENGTH_HINT = "a number of metres or a text such as '-20 mm'"
METRE_PARTS = {"mm": 1000, "cm": 100, "m": 1}  # of each unit in a metre, by the units' names

SceneName = Annotated[str, typer.Argument(help="A bundled scene's name, or the path of a scene file.")]
TorqueFile = Annotated[Path, typer.Option("--torque", help=TORQUE_HELP)]
OutputFolder = Annotated[
    Path | None, typer.Option(help="Folder for torque.csv, trajectory.csv, summary.json and figures.")
]
Changes = Annotated[
    list[str] | None,
    typer.Option("--set", help=SET_HELP),
]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON instead of text.")]
Samples = Annotated[int, typer.Option(min=2, help="Rows a phase in trajectory.csv.")]


def load_scene(name: str | Path, changes: list[str] | None = None):
    """Load a scene and apply the changes of `--set`."""
    from wholearm_jax.files import load

    scene = load(name)
    for change in changes or ():
        scene = _change_scene(scene, change)
    return scene


def _change_scene(scene, change: str):
    """Apply `PHASE.duration=SECONDS`, `PHASE.until.COORDINATE=VALUE` or `start.COORDINATE=VALUE`."""
    import equinox as eqx
    import numpy as np

    from wholearm_jax.model import COORDINATES, path_target, replace_duration

    key, _, value = change.partition("=")
    owner, _, field = key.rpartition(".")
    if owner == "start" and field in COORDINATES:
        start = np.array(scene.start)
        start[COORDINATES.index(field)] = read_coordinate(f"--set {change}", field, value)
        return eqx.tree_at(lambda s: s.start, scene, as_device_array(start))
    until = owner.endswith(".until") and field in COORDINATES
    row = phase_number(scene, owner.removesuffix(".until") if until else owner)
    if row is None or not (until or field == "duration"):
        names = ", ".join(p.name for p in scene.phases)
        others = "PHASE.until.COORDINATE=VALUE or start.COORDINATE=VALUE"
        raise BadInput(f"--set {change}: write PHASE.duration=SECONDS, {others}; phases: {names}")
    if until:
        limit = path_target(None, {field: read_coordinate(f"--set {change}", field, value)})
        limits = limit.until_coordinate, limit.until_value
        return eqx.tree_at(lambda s: _until_of(s.phases[row]), scene, limits)
    try:
        seconds = float(value)
    except ValueError:
        seconds = float("nan")
    if not 0 < seconds < float("inf"):
        raise BadInput(f"--set {change}: a duration is a positive number of seconds")
    return eqx.tree_at(lambda s: s.phases[row], scene, replace_duration(scene.phases[row], seconds))


def _until_of(phase):
    return phase.target.until_coordinate, phase.target.until_value


def read_coordinate(source: str, coordinate: str, text: str) -> float:
    """Read a coordinate's value: metres, radians, or a number with its unit; `source` is what an error names."""
    from wholearm_jax.files.angles import ANGLE_HINT, is_beyond_a_turn, read_angle
    from wholearm_jax.model import ANGLE_COORDINATES

    is_angle = coordinate in ANGLE_COORDINATES
    try:
        number = float(text)
        if is_angle and is_beyond_a_turn(number):
            note(f'{source}: {number:g} radians are more than a whole turn; degrees are written "{number:g} deg"')
    except ValueError:
        try:
            number = read_angle(text) if is_angle else _read_length(text)
        except ValueError:
            number = float("nan")
    if not abs(number) < float("inf"):
        raise BadInput(f"{source}: {coordinate} is {ANGLE_HINT if is_angle else LENGTH_HINT}")
    return number


def _read_length(text: str) -> float:
    """Return the metres of a text such as `-20 mm`; raise `ValueError` for one that is no length."""
    number, unit = next(((text.removesuffix(unit), unit) for unit in METRE_PARTS if text.endswith(unit)), (text, ""))
    return float(number) / METRE_PARTS.get(unit, 1)


def phase_number(scene, phase: str) -> int | None:
    """Return the number of a phase that is given by name or number, None if there is no such phase."""
    names = [p.name for p in scene.phases]
    numbered = phase.isdecimal() and int(phase) < len(names)
    return names.index(phase) if phase in names else int(phase) if numbered else None


def refuse_twice(source: str, names: list[str]) -> None:
    """Raise `BadInput` where a name stands twice; `source` is what the error names."""
    twice = next((name for k, name in enumerate(names) if name in names[:k]), None)
    if twice is not None:
        raise BadInput(f"{source}: {twice} stands twice")


def parse_ensemble(scene, amounts: list[str] | None, seed: int):
    """Make the ensemble that `QUANTITY=AMOUNT` arguments describe."""
    from wholearm_jax.ensembles import make_ensemble

    pairs = [text.partition("=") for text in amounts or ()]
    names = [name.strip() for name, _, _ in pairs]
    refuse_twice(", ".join(amounts or ()), names)
    try:
        return make_ensemble(scene, {name: pair[2].strip() for name, pair in zip(names, pairs, strict=True)}, seed=seed)
    except ValueError as error:
        raise BadInput(f"{error}") from None


@contextmanager
def refuse_unwritable(target: str) -> Iterator[None]:
    """Turn an `OSError` while writing to `target` into `BadInput`."""
    try:
        yield
    except OSError as error:
        raise BadInput(f"{target}: cannot be written: {error.strerror or error}") from None


def make_output_folder(out: Path | None) -> Path | None:
    """Make the output folder before a long computation, whose result a folder that cannot be written would lose."""
    if out is None:
        return None
    with refuse_unwritable(f"--out {out}"):
        out.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=out).close()
    return out


def note(text: str) -> None:
    """Print a note on standard error."""
    print(f"wholearm: note: {text}", file=sys.stderr)
