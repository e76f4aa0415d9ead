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

from wholearm_jax.core import BadInput

ARRIVAL_FRACTION = 0.01  # of a path's length: perturbed plans cannot end where an unperturbed one must
TORQUE_HELP = "Torque schedule, CSV with the header t,tau1,tau2."

SceneName = Annotated[str, typer.Argument(help="A bundled scene's name, or the path of a scene file.")]
TorqueFile = Annotated[Path, typer.Option("--torque", help=TORQUE_HELP)]
OutputFolder = Annotated[
    Path | None, typer.Option(help="Folder for torque.csv, trajectory.csv, summary.json and figures.")
]
Changes = Annotated[
    list[str] | None,
    typer.Option("--set", help="PHASE.duration=SECONDS; PHASE is a name or a number from 0. May be repeated."),
]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON instead of text.")]
Samples = Annotated[int, typer.Option(min=2, help="Rows a phase in trajectory.csv.")]


def load_scene(name: str, changes: list[str] | None = None):
    """Load a scene and apply the changes of `--set`."""
    from wholearm_jax.files import load

    scene = load(name)
    for change in changes or ():
        scene = _change_duration(scene, change)
    return scene


def _change_duration(scene, change: str):
    """Apply `PHASE.duration=SECONDS`."""
    import equinox as eqx

    from wholearm_jax.model import replace_duration

    key, _, value = change.partition("=")
    phase, _, field = key.rpartition(".")
    names = [p.name for p in scene.phases]
    row = phase_number(scene, phase)
    if field != "duration" or row is None:
        raise BadInput(f"--set {change}: write PHASE.duration=SECONDS; phases: {', '.join(names)}")
    try:
        seconds = float(value)
    except ValueError:
        seconds = float("nan")
    if not 0 < seconds < float("inf"):
        raise BadInput(f"--set {change}: a duration is a positive number of seconds")
    phases = tuple(replace_duration(p, seconds) if k == row else p for k, p in enumerate(scene.phases))
    return eqx.tree_at(lambda s: s.phases, scene, phases)


def phase_number(scene, phase: str) -> int | None:
    """Return the number of a phase that is given by name or number, None if there is no such phase."""
    names = [p.name for p in scene.phases]
    numbered = phase.isdecimal() and int(phase) < len(names)
    return names.index(phase) if phase in names else int(phase) if numbered else None


def parse_ensemble(scene, amounts: list[str] | None, seed: int):
    """Make the ensemble that `QUANTITY=AMOUNT` arguments describe."""
    from wholearm_jax.ensembles import make_ensemble

    pairs = [text.partition("=") for text in amounts or ()]
    try:
        return make_ensemble(scene, {name.strip(): amount.strip() for name, _, amount in pairs}, seed=seed)
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
