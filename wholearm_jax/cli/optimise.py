"""`wholearm optimise`: the torques with the largest margin, for one scene or (`--robust`) for an ensemble."""

import math
import sys
import time
from pathlib import Path
from typing import Annotated, Any

import typer

from wholearm_jax.cli.arguments import (
    ARRIVAL_FRACTION,
    AsJson,
    BadInput,
    Changes,
    OutputFolder,
    SceneName,
    load_scene,
    make_output_folder,
    note,
    parse_ensemble,
)
from wholearm_jax.cli.output import write_and_exit, write_result
from wholearm_jax.cli.prediction import trace_or_exit
from wholearm_jax.cli.progress import solver_progress
from wholearm_jax.core import Status


def optimise(
    scene: SceneName,
    out: OutputFolder = None,
    set_: Changes = None,
    knots: Annotated[
        int | None, typer.Option(min=3, help="Torque knots a phase (51, and 201 where those cost margin).")
    ] = None,
    steps: Annotated[int, typer.Option(min=1, help="Most steps of descent from each start.")] = 160,
    rate_limit: Annotated[float | None, typer.Option(min=1e-9, help="Largest torque rate [N m/s].")] = None,
    margin: Annotated[
        float | None, typer.Option(min=0.0, help="The shortest durations with at least this margin [N] everywhere.")
    ] = None,
    passing: Annotated[
        float | None, typer.Option(min=0.0, help="Least speed at changes of formation, over the mean speed (0.2).")
    ] = None,
    samples: Annotated[
        int | None, typer.Option(min=2, help="Rows a phase in trajectory.csv (201), or samples.")
    ] = None,
    robust: Annotated[
        list[str] | None,
        typer.Option(help="QUANTITY=AMOUNT: the best torques for --samples (64) varied scenes."),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of the varied scenes.")] = 0,
    arrival: Annotated[float, typer.Option(min=1e-9, max=1.0, help="As of `check`, for --robust.")] = ARRIVAL_FRACTION,
    feedback: Annotated[
        bool, typer.Option("--feedback", help="Also controller.json, a closed-loop law for the plan.")
    ] = False,
    report: Annotated[bool, typer.Option("--report", help="Also report.html, one page with an animation.")] = False,
    as_json: AsJson = False,
) -> None:
    """Find the torques with the largest compressive margin.

    A simulation checks them.
    """
    if report and out is None:
        raise BadInput("--report: needs a folder to write to: add --out DIR")
    if feedback and out is None:
        raise BadInput("--feedback: needs --out DIR to write to")
    loaded = load_scene(scene, set_)
    folder = make_output_folder(out)
    uncertain = _uncertain_set(loaded, robust, seed) if feedback else {}
    from wholearm_jax.optimisation import DEFAULT_KNOTS, MIN_TRANSITION_SPEED

    if robust and not feedback:
        others = (("rate-limit", rate_limit), ("passing", passing), ("margin", margin))
        unknown = [name for name, value in others if value is not None]
        if unknown:
            raise BadInput(f"--robust: knows no --{unknown[0]}")
        ensemble = parse_ensemble(loaded, robust, seed)
        _optimise_ensemble(ensemble, folder, samples or 64, knots or DEFAULT_KNOTS, steps, arrival, report, as_json)
    passing = MIN_TRANSITION_SPEED if passing is None else passing
    options = {"knots": knots, "steps": steps, "rate_limit": rate_limit, "passing": passing, "margin": margin}
    begun = time.perf_counter()
    optimum = _optimise_scene(scene, loaded, options)
    more = {
        "command": "optimise",
        "knots": optimum.knots,
        "steps": len(optimum.history),
        "seconds": time.perf_counter() - begun,
    }
    more |= {"rate_limit": rate_limit, "passing": passing, "wanted_margin": margin, "stopped": list(optimum.stopped)}
    if not as_json:
        _print_optimised(optimum)
    values = tuple(float(b.value) for b in optimum.bounds)
    controller = _design(optimum, uncertain, as_json) if feedback and optimum.result.status is Status.OK else None
    more |= {"controller": controller, "law_is_asked_for": feedback, "bounds": values}
    if feedback and controller is None and optimum.result.status is Status.OK:
        write_result(optimum.result, folder, samples or 201, as_json, report=report, **more)
        sys.exit(1)
    write_and_exit(optimum.result, folder, samples or 201, as_json, report=report, **more)


def _uncertain_set(scene, robust: list[str] | None, seed: int) -> dict[str, float]:
    """Return the half widths of friction, mass and vertices that a closed-loop law is designed for."""
    spreads = dict(parse_ensemble(scene, robust or ["friction=20%"], seed).spreads)
    relative = {"friction": True, "mass": True, "vertices": False}
    if any(relative.get(name) is not spread.relative for name, spread in spreads.items()):
        raise BadInput("--feedback: --robust knows friction=20%, mass=10% and vertices=0.0005 [m]")
    return {name: spread.size for name, spread in spreads.items()}


def _design(optimum, uncertain: dict[str, float], as_json: bool):
    """Design the closed-loop law of an optimised plan, and say which margin each phase keeps; None where it keeps none.

    Args:
        optimum: the result of `optimise`.
        uncertain: half widths of friction, mass and vertices.
        as_json: whether standard output is for JSON alone.
    """
    from wholearm_jax.feedback import feedback, held_set, least_passing_impulse

    objects: dict[str, Any] = {name: uncertain.get(name, 0.0) for name in ("friction", "mass")}
    objects["shape"] = uncertain.get("vertices")
    try:
        controller = feedback(optimum.scene, optimum.torque, **objects)
    except ValueError as error:
        note(f"no controller.json: {error}")
        return None
    for phase in controller.phases if not as_json else ():
        print(f"{phase.name}: closed loop, least force {phase.margin:.4g} N over all objects of the set")
    weakest = min(controller.phases, key=lambda phase: phase.margin)
    if weakest.margin > 0:
        _note_impulse(optimum.scene, least_passing_impulse(optimum.scene, objects["friction"], objects["mass"]))
        return controller
    why = f"a contact of some object of the set would open, least force {weakest.margin:.3g} N"
    if weakest.margin == -math.inf:
        why = "some object of the set would not follow, or not end where it should"
    smaller = _what_holds(held_set(optimum.scene, optimum.torque, **objects), uncertain)
    note(f"no controller.json: in '{weakest.name}' {why}; {smaller}")
    return None


def _note_impulse(scene, impulse) -> None:
    """Say where an impulse pulls between phases that follow one another without a stop."""
    from wholearm_jax.phases import MAX_OPENING

    if impulse is not None and impulse.share < 0:
        note(
            f"'{scene.phases[impulse.phase].name}': for some objects of the set the impulse at its beginning pulls at"
            f" {impulse.contact}, {-100 * impulse.share:.2g} % of the largest: the contact opens for an instant, and"
            f" `check` counts it as lost if by more than {1e6 * MAX_OPENING:.2g} micrometre"
        )


def _what_holds(held, uncertain: dict[str, float]) -> str:
    """Say for which smaller set, and with which motors, there is a law."""
    widths = {name: held.share * width for name, width in uncertain.items() if held.share * width > 0}
    smaller = " ".join(
        f"--robust {name}={width:.3g}" if name == "vertices" else f"--robust {name}={100 * width:.3g}%"
        for name, width in widths.items()
    )
    said = f"a law holds {smaller}" if smaller else "no law holds a quarter of its ranges either"
    if held.motors is None:
        return said
    return f"{said}; with torque limits {held.motors:g} times as large, one holds all of it"


def _optimise_scene(name: str, scene, options: dict):
    """Trace and optimise one scene, with a progress bar for each phase."""
    from wholearm_jax.optimisation import DEFAULT_KNOTS, precompile_optimise
    from wholearm_jax.optimisation import optimise as solve

    precompile_optimise(scene, knots=options["knots"] or DEFAULT_KNOTS)
    traced = trace_or_exit(name, scene)
    with solver_progress() as progress:
        bars = [progress.add_task(p.name, total=options["steps"], state="waiting") for p in scene.phases]

        def show(step):
            state = f"margin {step.margin:.4f} N, apart {step.defect_norm:.0e}"
            progress.update(bars[step.phase], completed=step.iteration + 1, state=state)

        progress.update(bars[0], state="compiling")
        try:
            optimum = solve(scene, **options, callback=show, traced=traced)
        except ValueError as error:
            if options["margin"] is None:
                raise
            raise BadInput(f"{name}: --margin: {error}") from None
        for bar, reason in zip(bars, optimum.stopped, strict=True):
            progress.update(bar, completed=options["steps"], state=reason)
    return optimum


def _print_optimised(optimum) -> None:
    """Print a line for each phase: message, bound, fraction of the bound reached, and why the solver stopped."""
    for phase, bound, fraction, reason in zip(
        optimum.result.phases, optimum.bounds, optimum.bound_fraction, optimum.stopped, strict=True
    ):
        ok = phase.status.value == 0 and 0 < fraction < float("inf")  # a failed plan may not come to the hard part
        reached = f", {100 * fraction:.1f} % of it reached" if ok else ""
        print(f"{phase.message}; bound {float(bound.value):.4g} N{reached}; stopped: {reason}")
        for rest in phase.holds:
            if rest.may_move:
                print(f"    {rest.message}")


def _optimise_ensemble(
    ensemble, folder: Path | None, samples: int, knots: int, steps: int, arrival: float, report: bool, as_json: bool
) -> None:
    """Optimise for an ensemble, print the scores, write the nominal scene's result, and exit."""
    from wholearm_jax.ensembles import optimise_robustly
    from wholearm_jax.optimisation import bounds
    from wholearm_jax.phases import require_motion, simulate

    try:
        require_motion(ensemble.scene)
    except ValueError as error:
        raise BadInput(f"--robust: {error}") from None
    with solver_progress() as progress:
        bar = progress.add_task("robust", total=steps + 1, state="the nominal schedule")

        def show(step, score):
            state = f"{100 * score.success_rate:.0f} % hold, worst {score.margin:.4f} N"
            progress.update(bar, completed=step + 1, state=state)

        optimum = optimise_robustly(ensemble, samples=samples, knots=knots, steps=steps, arrival=arrival, callback=show)
    for name, scores in (("sampled", optimum.in_sample), ("unseen", optimum.out_of_sample)):
        nominal, robust = (f"{100 * s.success_rate:.1f} % hold, worst margin {s.margin:.4g} N" for s in scores)
        if not as_json:
            print(f"{samples} {name} scenes: nominal {nominal}; robust {robust}")
    result = simulate(ensemble.scene, optimum.torque, arrival=arrival)
    nominal, robust = optimum.out_of_sample
    more = {"command": "optimise --robust", "knots": knots, "steps": steps, "varied": samples, "arrival": arrival}
    amounts = (f"{name}={100 * a.size:g}%" if a.relative else f"{name}={a.size:g}" for name, a in ensemble.spreads)
    more |= {"robust": ", ".join(amounts), "seed": ensemble.seed}
    more |= {"unseen_share": robust.success_rate, "unseen_margin": robust.margin}
    more |= {"unseen_share_nominal": nominal.success_rate, "unseen_margin_nominal": nominal.margin}
    values = tuple(float(b.value) for b in bounds(ensemble.scene))
    write_result(result, folder, 201, as_json, report, bounds=values, **more)
    sys.exit(0 if robust.success_rate == 1.0 else 1)
