"""`wholearm plan`: phases that lead from a start to a goal."""

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
    read_coordinate,
    refuse_twice,
    refuse_unwritable,
)
from wholearm_jax.cli.progress import solver_progress
from wholearm_jax.cli.tables import Column, print_json, print_table

GOAL_HELP = 'Where the object is to be, such as "x=-30 mm,phi=-40 deg"; instead of the scene\'s [goal].'
HAND_HELP = (
    "Search for the hand, too: ranges of finger length and of each joint's distance from the middle [m], "
    'such as "length=0.08:0.20,joint=0.03:0.08".'
)
REGRASP_HELP = (
    "Allow regrasps, in which a finger leaves the object and touches it again: each time that a finger moves alone "
    "counts as so many phases more."
)
COLUMNS = ("phase", "contacts", "toward", "until")
NUMBERS = ("from x, y mm", "phi deg", "to x, y mm", "phi deg", "turn deg", "bound N")


def plan(
    scene: SceneName,
    goal: Annotated[str | None, typer.Option(help=GOAL_HELP)] = None,
    by: Annotated[str | None, typer.Option(help='The same, relative to the start, such as "x=-30 mm".')] = None,
    tolerance: Annotated[str | None, typer.Option(help='Such as "x=1 mm,phi=1 deg", which is the default.')] = None,
    margin: Annotated[float, typer.Option(help="Least margin of compressive force that a plan must allow [N].")] = 0.0,
    count: Annotated[int, typer.Option(min=1, help="Number of plans at most.")] = 3,
    phases: Annotated[int, typer.Option(min=1, help="Longest plan.")] = 24,
    time: Annotated[float, typer.Option(min=0.0, help="Seconds after which the search ends with what it has.")] = 60.0,
    rolling: Annotated[bool, typer.Option(help="Whether contacts may roll.")] = True,
    regrasp_cost: Annotated[float | None, typer.Option(min=0.0, help=REGRASP_HELP)] = None,
    hand_from: Annotated[str | None, typer.Option(help=HAND_HELP)] = None,
    out: Annotated[
        Path | None,
        typer.Option(help="Folder for plan.toml, further plans, pictures of their poses and the search."),
    ] = None,
    optimise: Annotated[bool, typer.Option("--optimise", help="Go on to torques for the best plan.")] = False,
    as_json: AsJson = False,
) -> None:
    """Find phases that lead the object from its start to a goal."""
    from wholearm_jax.files import load_goal, load_start
    from wholearm_jax.planning import make_goal
    from wholearm_jax.planning import plan as find_plans

    loaded, folder = load_start(scene), make_output_folder(out)
    wanted = _goal(scene, load_goal(scene), goal, by, tolerance)
    limits = {"margin": margin, "count": count, "max_phases": phases, "rolling": rolling, "time_limit": time}
    limits |= {"regrasp_cost": regrasp_cost}
    try:
        make_goal(loaded.start, **wanted)  # refused before anything is shown
        with solver_progress() as progress:
            bar = progress.add_task("plan", total=None, state="compiling")

            def show(nodes: int, distance: float) -> None:
                progress.update(bar, state=f"{nodes} poses, the nearest about {distance:.1f} moves from the goal")

            if hand_from is not None:
                loaded = _find_hand(loaded, hand_from, wanted, limits, progress, bar)
            found = find_plans(loaded, **wanted, **limits, callback=show)
    except ValueError as error:
        raise BadInput(f"{scene}: {error}") from None
    shown = found.plans or (() if found.nearest is None else (found.nearest,))
    if as_json:
        print_json({"reason": found.reason, "plans": [_json_plan(one) for one in found.plans]})
    else:
        for number, one in enumerate(shown, 1):
            title = f"plan {number}: bound {one.bound:.3g} N" if found.found else "as near as it gets:"
            print_table([*map(Column, COLUMNS), *(Column(name, True) for name in NUMBERS)], _rows(one), title)
    if folder is not None:
        _write(folder, found, shown)
    if not found.found:
        if not as_json:
            note(f"{scene}: {found.reason}")
            if hints := _hints(found, loaded, limits, searched_hand=hand_from is not None):
                note(f"what may help: {'; '.join(hints)}")
        raise typer.Exit(1)
    if optimise:
        _optimise(found.plans[0], folder)


def _find_hand(scene, text: str, wanted: dict[str, Any], limits: dict[str, Any], progress, bar):
    """Return the scene with the hand, of those in the ranges, on which the goal's plan has the largest certificate.

    Where no hand has a plan, with the one that came nearest to the goal.
    """
    from wholearm_jax.planning import plan_with_hand

    def show(hands: int, bound: float) -> None:
        progress.update(bar, state=f"{hands} hands, the largest bound {bound:.3g} N")

    length, joint = _read_ranges(text)
    found = plan_with_hand(scene, length=length, joint=joint, callback=show, **wanted, **limits)
    planned = sum(trial.bound > float("-inf") for trial in found.trials)
    closing = sum(not math.isnan(trial.bound) for trial in found.trials)
    tried = f"of {len(found.trials)} hands {closing} close on the object, {planned} have a plan"
    chosen = found.scene if found.nearest is None else found.nearest
    hand = chosen.hand
    dimensions = f"joints at -+{abs(float(hand.joint[0, 0])):.4g} m, fingers {float(hand.length[0]):.4g} m long"
    if found.best is not None:
        outcome = f"the best: {dimensions}"
    elif found.nearest is not None:
        outcome = f"the nearest, searched for longer: {dimensions}"
    else:
        outcome = "the scene's own hand is kept"
    note(f"--hand-from {text}: {tried}; {outcome}")
    return chosen


def _hints(found, scene, limits: dict[str, Any], *, searched_hand: bool) -> list[str]:
    """Say what has not been tried yet that lets more goals be reached; nothing where not even the start is possible."""
    from wholearm_jax.planning import hand_ranges

    hints = []
    if not found.moves and not found.out_of_time:
        return hints
    if found.out_of_time:
        hints.append(f"--time {max(5 * limits['time_limit'], 60):.4g}, for a longer search")
    if limits["regrasp_cost"] is None:
        hints.append("--regrasp-cost 1, so that fingers may go elsewhere")
    if not searched_hand:
        hints.append(f"--hand-from {hand_ranges(scene.hand)}, to search for the hand")
    if "phi" in found.goal.values:
        palm, *fingers = (float(value) for value in scene.object.friction)
        friction = " and more friction at the palm" if palm <= max(fingers) else ""
        hints.append(f"a start on another edge{friction}: what lies flat hardly tips")
    return hints


def _read_ranges(text: str) -> tuple[tuple[float, float], tuple[float, float]]:
    """Read the two ranges of `length=0.08:0.20,joint=0.03:0.08`."""
    ranges = {}
    try:
        for part in text.split(","):
            name, _, limits = (piece.strip() for piece in part.partition("="))
            low, high = map(float, limits.split(":"))
            ranges[name] = low, high
    except ValueError:
        ranges = {}
    if ranges.keys() != {"length", "joint"}:
        raise BadInput(f"--hand-from {text}: write both ranges [m], such as length=0.08:0.20,joint=0.03:0.08")
    return ranges["length"], ranges["joint"]


def _goal(name: str, own: dict[str, Any] | None, goal, by, tolerance) -> dict[str, Any]:
    """Return the goal's arguments: those of the command line, else the scene's."""
    if goal is None and by is None:
        if own is None:
            raise BadInput(f"{name}: goal: missing; write a table [goal], or --goal or --by")
        return own | ({"tolerance": _read(tolerance, "--tolerance")} if tolerance else {})
    texts = {"goal": goal, "by": by, "tolerance": tolerance}
    return {key: _read(text, f"--{key}") for key, text in texts.items() if text is not None}


def _read(text: str, option: str) -> dict[str, float]:
    """Read `x=-0.03,phi=-40 deg`."""
    from wholearm_jax.model import COORDINATES

    pairs = [[piece.strip() for piece in part.partition("=")] for part in text.split(",")]
    if any(name not in COORDINATES for name, _, _ in pairs):
        raise BadInput(f"{option} {text}: write coordinates and values such as x=-0.03,phi=-40 deg")
    refuse_twice(f"{option} {text}", [name for name, _, _ in pairs])
    return {name: read_coordinate(f"{option} {text}", name, value) for name, _, value in pairs}


def _json_plan(one) -> dict[str, Any]:
    """Return a plan in SI units."""
    rows = zip(one.steps, one.begins, one.ends, one.bounds, one.reasons, strict=True)
    return {
        "bound": one.bound,
        "phases": [
            {
                "contacts": step.contacts,
                "regrasp": step.regrasp,
                "toward": step.toward,
                "until": dict([step.until]) if step.until else None,
                "begin": begin.tolist(),
                "end": end.tolist(),
                "turn_degrees": math.degrees(end[2] - begin[2]),
                "bound": bound,
                "ends": reason,
            }
            for step, begin, end, bound, reason in rows
        ],
    }


def _rows(one) -> list[tuple[str, ...]]:
    """Return the cells of a plan's table."""
    rows = []
    for k, (step, begin, end, bound) in enumerate(zip(one.steps, one.begins, one.ends, one.bounds, strict=True)):
        poses = [
            text for z in (begin, end) for text in (f"{1e3 * z[0]:.1f}, {1e3 * z[1]:.1f}", f"{math.degrees(z[2]):.1f}")
        ]
        until = one.reasons[k] if step.until is None else f"{step.until[0]} = {step.until[1]:.4g}"
        turn = f"{math.degrees(end[2] - begin[2]):.1f}"
        contacts = [f"regrasp {step.regrasp}:", *step.contacts] if step.regrasp else step.contacts
        rows.append((str(k + 1), " ".join(contacts), step.toward, until, *poses, turn, f"{bound:.3g}"))
    return rows


def _write(folder: Path, found, shown) -> None:
    """Write each plan as a scene, a strip of its poses, and a picture of the search."""
    from wholearm_jax.files import FileSet, replace_files, save
    from wholearm_jax.plotting import plot_plan_poses, plot_search, save_figure

    first = "plan" if found.found else "nearest"
    names = [first, *(f"{first}{number}" for number in range(2, len(shown) + 1))]
    former = [path.stem for path in folder.glob("plan*.toml")] if found.found else []
    files = FileSet(None, tuple(f"{name}.toml" for name in {*names, *former}), (*{*names, *former}, "search"))
    with refuse_unwritable(f"--out {folder}"), replace_files(folder, files) as scratch:
        for name, one in zip(names, shown, strict=False):
            save(one.scene, scratch / f"{name}.toml")
            save_figure(lambda one=one: plot_plan_poses(one.scene, one.begins, one.ends), scratch, name)
        save_figure(lambda: plot_search(found), scratch, "search")


def _optimise(best, folder: Path | None) -> None:
    """Optimise the best plan, and say what became of it."""
    from wholearm_jax.cli.output import write_and_exit
    from wholearm_jax.optimisation import optimise

    optimum = optimise(best.scene)
    values = tuple(float(bound.value) for bound in optimum.bounds)
    write_and_exit(optimum.result, folder, 201, False, bounds=values, command="optimise")
