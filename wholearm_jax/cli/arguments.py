"""What the commands have in common: their arguments, what these stand for, and what is said of unusable ones.

What takes long to import is imported where it is used: a command that needs none of it starts at once.
"""

import sys
import tempfile
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import jax
import typer

SceneName = Annotated[str, typer.Argument(help="A bundled scene's name, or the path of a scene file.")]
TORQUE = "Torque schedule, CSV with the header t,tau1,tau2."
TorqueFile = Annotated[Path, typer.Option("--torque", help=TORQUE)]


class BadInput(Exception):
    """What the user gave cannot be used; the message is one line."""


def load_scene(name: str, changes: list[str] | None):
    """Load a scene and apply `--set`."""
    from wholearm_jax.files import load

    scene = load(name)
    for change in changes or ():
        scene = _changed(scene, change)
    return scene


def counting_progress(told: str):
    """A progress bar on the terminal that counts, with its task's field in the text `told` and the time left."""
    from rich.progress import TextColumn, TimeElapsedColumn, TimeRemainingColumn

    return _progress(
        TextColumn("{task.completed}/{task.total}"), TextColumn(told), TimeElapsedColumn(), TimeRemainingColumn()
    )


def descent_progress():
    """A progress bar on the terminal for each descent, with its task's field `state`: the time left is not known."""
    from rich.progress import TextColumn, TimeElapsedColumn

    return _progress(TextColumn("{task.fields[state]}"), TimeElapsedColumn())


def _progress(*columns):
    """Progress bars, each named, with columns behind them."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn

    return Progress(TextColumn("{task.description}"), BarColumn(), *columns, console=Console(stderr=True))


def _changed(scene, change: str):
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
    """The number of a phase given by name or number."""
    names = [p.name for p in scene.phases]
    numbered = phase.isdecimal() and int(phase) < len(names)
    return names.index(phase) if phase in names else int(phase) if numbered else None


def traced_or_refused(name: str, scene):
    """Trace a plan; refuse it, naming the contact, where a formation's contacts cannot all touch where it begins."""
    import numpy as np

    from wholearm_jax.model import anchor_rolling, constraints, contact_kinematics, rigid_body, scaled_mechanics
    from wholearm_jax.phases import target_configuration, trace

    @jax.jit
    def apart(formation, z, initial_guess):
        mechanics = scaled_mechanics(rigid_body(scene.object), scene.hand, scene.gravity, formation)
        held = anchor_rolling(mechanics.contacts, initial_guess / mechanics.configuration_unit)
        at, missed = contact_kinematics(held, z), jax.numpy.abs(constraints(held, z))
        beyond = jax.numpy.maximum(0.0, jax.numpy.maximum(held.lower - at.along, at.along - held.upper))
        gap = jax.numpy.where(held.tangential, missed, jax.numpy.hypot(at.gap, beyond))
        return gap, mechanics.length, mechanics.configuration_unit

    traced = trace(scene)
    for k, (phase, at) in enumerate(zip(scene.phases, traced, strict=True)):
        if int(at.dynamics.status) == 0:
            continue
        initial_guess = target_configuration(scene.phases[k - 1], traced[k - 1]) if k > 0 else scene.start
        gap, length, unit = apart(phase.formation, at.path.start, initial_guess)
        where = "with the others, from this start"
        if k > 0 and not np.any(gap > 1e-6):
            gap, _, _ = apart(phase.formation, initial_guess / unit, initial_guess)
            where = f"where phase '{scene.phases[k - 1].name}' ends"
        if not np.all(gap <= 1e-6):
            worst = int(np.argmax(gap))
            which = phase.formation.names[phase.formation.contact_of_row[worst]]
            key, size = f"phase[{k}].contacts", float(gap[worst] * length)
            if phase.formation.tangential[worst]:
                raise BadInput(f"{name}: {key}: {which} cannot stay in its place {where}: it is off by {size:.3g} m")
            raise BadInput(f"{name}: {key}: {which} cannot touch {where}: a gap of {size:.3g} m stays open")
        break  # what follows a wire that cannot be followed has no start
    _note_unreached(name, scene, traced)
    return traced


def _note_unreached(name: str, scene, traced) -> None:
    """Say where a phase ends before its `until`."""
    from wholearm_jax.model import COORDINATES
    from wholearm_jax.tracing import UNTIL

    for k, (phase, at) in enumerate(zip(scene.phases, traced, strict=True)):
        which = int(phase.target.until_coordinate)
        if which >= 0 and int(at.dynamics.status) == 0 and int(at.path.end_reason) != UNTIL:
            begin, end = (float(z[which]) for z in (at.begin, at.end))
            wanted = f"{COORDINATES[which]} = {float(phase.target.until_value):.6g}"
            note(f"{name}: phase[{k}].until: {wanted} is not on its wire, which leads from {begin:.6g} to {end:.6g}")


def note(text: str) -> None:
    """Tell what may not be what was meant."""
    print(f"wholearm: note: {text}", file=sys.stderr)


def note_limit_violations(scene, schedule, torque: Path) -> None:
    """Say where a schedule asks for more than a joint's torque limit."""
    from wholearm_jax.model import limit_violations

    for joint, size, when, limit in limit_violations(schedule, scene.hand.torque_limit):
        note(f"{torque}: |tau{joint}| is {size:.4g} N m at t = {when:.4g} s, beyond the limit of {limit:.4g} N m")


def simulate_prediction(scene, schedule, torque: Path, tolerance: float, traced):
    """Simulate a plan under a schedule; refuse one from the file `torque` that is too short."""
    from wholearm_jax.phases import simulate as follow

    note_limit_violations(scene, schedule, torque)
    try:
        return follow(scene, schedule, tolerance=tolerance, traced=traced)
    except ValueError as error:
        raise BadInput(f"{torque}: {error}") from None


@contextmanager
def writing(where: str):
    """Say in one line that a place cannot be written to."""
    try:
        yield
    except OSError as error:
        raise BadInput(f"{where}: cannot be written: {error.strerror or error}") from None


def make_output_folder(out: Path | None) -> Path | None:
    """Make the output folder now, so that a long computation is not lost to a folder that cannot be written."""
    if out is None:
        return None
    with writing(f"--out {out}"):
        out.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=out).close()
    return out
