"""The convex programme of a path against the descent: is the certificate an upper bound, how near does descent come?

    python benchmarks/best_motions.py --count 12 --durations 1.0 0.3 0.15

For each phase of random plans: the pointwise bound, the certificate with 200 and with 400 intervals (their difference
says what discretisation adds), the margin of `wa.optimise`, and its fraction of the certificate.
"""

import argparse

import equinox as eqx
from random_plans import random_plans

import wholearm_jax as wa
from wholearm_jax.core import as_device_array
from wholearm_jax.margin import PROGRAMME_INTERVALS, largest_margin, rest_to_rest
from wholearm_jax.model import replace_duration


def compare(scene: wa.Scene, seconds: float) -> list[str]:
    """A line for each phase of a plan whose phases last so long."""
    lasting = tuple(replace_duration(phase, seconds) for phase in scene.phases)
    scene = eqx.tree_at(lambda s: s.phases, scene, lasting)
    traced = wa.trace(scene)
    pointwise, optimum = wa.bounds(scene, traced=traced), wa.optimise(scene, traced=traced)
    lines = []
    for path, bound, phase in zip(traced, pointwise, optimum.result.phases, strict=True):
        given = path.dynamics, as_device_array(seconds), rest_to_rest()
        coarse, fine = (largest_margin(*given, 0, k * PROGRAMME_INTERVALS) for k in (1, 2))
        certificate, finer = float(coarse.margin), float(fine.margin)
        numbers = f"{float(bound.value):8.4f} {certificate:8.4f} {finer - certificate:9.1e} {phase.margin:8.4f}"
        steps = f"{phase.margin / certificate:7.4f} {int(coarse.iterations):4d} {bool(coarse.converged)}"
        lines.append(f"{seconds:5.2f} {numbers} {steps} {phase.status.label}")
    return lines


def main() -> None:
    wa.configure()
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--count", type=int, default=12)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--durations", type=float, nargs="+", default=[1.0, 0.3, 0.15])
    chosen = parser.parse_args()
    print("    s  pointw.  certif.  finer by  reached fraction iterations converged status")
    for number, scene in enumerate(random_plans(chosen.count, chosen.seed)):
        for seconds in chosen.durations:
            for line in compare(scene, seconds):
                print(f"{number:2d} {line}", flush=True)


if __name__ == "__main__":
    main()
