r"""Many scenes: how many a second one schedule is checked against, over their number; compile time and memory.

    python benchmarks/batch.py [--quick]

The heptagon's whole plan, traced anew for every scene (vertices within 0.2 mm, friction within 10 %), in one process on
one processor. The largest difference of a margin from the full resolution is measured on the smallest batch. The first
call compiles and is kept apart.
"""

import argparse
import resource
import time
from pathlib import Path

import jax
import matplotlib.pyplot as plt
import measure
import numpy as np

import wholearm_jax as wa
from wholearm_jax.batch import BLOCK

jax.config.update("jax_enable_x64", True)

HERE = Path(__file__).parent
COUNTS = (128, 1024, 10_240, 102_400)


def memory() -> float:
    """The largest resident size so far [MiB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def main() -> None:
    """Measure, save, draw, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="the two smallest batches")
    counts = COUNTS[:2] if parser.parse_args().quick else COUNTS
    jax.config.update("jax_enable_compilation_cache", False)  # compile times are to be fresh
    ensemble = wa.vary(wa.load("heptagon"), {"vertices": 0.0002, "friction": "10%"}, seed=1)
    torque = wa.read_torque(HERE / "data" / "heptagon_knots.csv")
    rows = []
    begun = time.perf_counter()
    quick = wa.check(ensemble, torque, count=BLOCK, arrival=0.02)
    first = time.perf_counter() - begun
    full = wa.check(ensemble, torque, count=BLOCK, arrival=0.02, tolerance=1e-10)
    error = float(np.abs(quick.margin - full.margin).max())
    for count in counts:
        begun = time.perf_counter()
        wa.check(ensemble, torque, count=count, arrival=0.02)
        rows.append({"count": count, "rate": count / (time.perf_counter() - begun), "memory": memory()})
        print(f"{count} scenes: {rows[-1]['rate']:.0f} a second, {rows[-1]['memory']:.0f} MiB", flush=True)
    print(f"first call, with compiling: {first:.1f} s; largest error of a margin {error:.1e} N")
    path = measure.save("batch", {"first": first, "error": error, "rows": rows})
    figure, axes = plt.subplots(figsize=(3.6, 2.8), layout="constrained")
    axes.loglog([r["count"] for r in rows], [r["rate"] for r in rows], marker="o", color="#0072B2")
    axes.set(xlabel="scenes", ylabel="scenes a second")
    figure.savefig(path.with_suffix(".svg"))


if __name__ == "__main__":
    main()
