"""`wholearm optimise --robust`: torques for an ensemble of scenes instead of one."""

import sys
from pathlib import Path

from wholearm_jax.cli.arguments import BadInput, descent_progress
from wholearm_jax.cli.output import write_result


def optimise_robustly(
    varied, folder: Path | None, samples: int, knots: int, steps: int, arrival: float, report: bool
) -> None:
    """Find the torques, say how they do on seen and unseen scenes, write what becomes of the nominal one, and exit."""
    from wholearm_jax.ensembles import optimise_robustly as find
    from wholearm_jax.optimisation import bounds
    from wholearm_jax.phases import require_motion, simulate

    try:
        require_motion(varied.scene)
    except ValueError as error:
        raise BadInput(f"--robust: {error}") from None
    with descent_progress() as progress:
        bar = progress.add_task("robust", total=steps + 1, state="the nominal schedule")

        def show(step, held):
            progress.update(
                bar, completed=step + 1, state=f"{100 * held.success_rate:.0f} % hold, worst {held.margin:.4f} N"
            )

        found = find(varied, samples=samples, knots=knots, steps=steps, arrival=arrival, callback=show)
    for name, (nominal, robust) in (("sampled", found.in_sample), ("unseen", found.out_of_sample)):
        told = (f"{100 * h.success_rate:.1f} % hold, worst margin {h.margin:.4g} N" for h in (nominal, robust))
        print(f"{samples} {name} scenes: nominal {next(told)}; robust {next(told)}")
    result = simulate(varied.scene, found.torque, arrival=arrival)
    nominal, robust = found.out_of_sample
    more = {"command": "optimise --robust", "knots": knots, "steps": steps, "varied": samples, "arrival": arrival}
    amounts = (f"{name}={100 * a.size:g}%" if a.relative else f"{name}={a.size:g}" for name, a in varied.spreads)
    more |= {"robust": ", ".join(amounts), "seed": varied.seed}
    more |= {"unseen_share": robust.success_rate, "unseen_margin": robust.margin}
    more |= {"unseen_share_nominal": nominal.success_rate, "unseen_margin_nominal": nominal.margin}
    tops = tuple(float(b.value) for b in bounds(varied.scene))
    write_result(result, folder, 201, report, bounds=tops, **more)
    sys.exit(0 if robust.success_rate == 1.0 else 1)
