"""Stability sweep: random scenes over many decades, each of which must end in a result that passes the checks or in the
status that names the reason.

    python -m benchmarks.stability [--count 100000] [--seed 1] [--quick]

The scenes come from `scenes`, the package's own steps from `programs`; what must hold is checked by
`checks`, on mechanics written a second time in `tests.reference.mechanics`. Paths are traced at the default resolution.
What that cannot resolve goes on to a finer table, and what needs more steps gets them, as `wholearm_jax.trace` and
`simulate` do for one scene. A tenth of the scenes runs again in single precision.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.stability import scenes

ROOT = Path(__file__).parents[2]


def main():
    options = parsed()
    if options.part is not None:
        from benchmarks.stability.sweep import work

        return work(options.part, options.seed, single=options.single, target=Path(options.target))
    begun = time.perf_counter()
    blocks = max(1, round(options.count / scenes.BLOCK))
    double = collected(range(blocks), options, single=False)
    single = collected(range(max(1, blocks // 10)), options, single=True)
    from benchmarks.stability.report import report

    report(double, single, options.seed, time.perf_counter() - begun, keep=not options.quick)
    return None


def parsed():
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--quick", action="store_true", help="4,000 scenes; saves nothing")
    parser.add_argument("--processes", type=int, default=os.cpu_count())
    parser.add_argument("--part", type=int, nargs="*", help=argparse.SUPPRESS)
    parser.add_argument("--single", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--target", help=argparse.SUPPRESS)
    options = parser.parse_args()
    options.count = 4000 if options.quick else options.count
    return options


def collected(blocks, options, *, single):
    """The records of all blocks, computed in several processes of one thread each.

    One thread each, because batched LAPACK calls of one XLA program can block each other for good in a small thread
    pool (seen with jaxlib 0.10.2: `ParallelBatchMap` waits inside a worker thread).
    """
    surroundings = os.environ | {"NPROC": "1", "OMP_NUM_THREADS": "1", "JAX_PLATFORMS": "cpu"}
    shares = [list(blocks)[k :: options.processes] for k in range(options.processes)]
    with tempfile.TemporaryDirectory() as folder:
        running = []
        for number, share in enumerate(s for s in shares if s):
            target = Path(folder) / f"{number}.npz"
            command = [
                sys.executable,
                "-m",
                "benchmarks.stability",
                "--seed",
                str(options.seed),
                "--target",
                str(target),
            ]
            command += (["--single"] if single else []) + ["--part", *map(str, share)]
            running.append((target, subprocess.Popen(command, env=surroundings, cwd=ROOT)))
        for _, process in running:
            if process.wait():
                raise SystemExit("a process of the sweep failed")
        parts = [dict(np.load(target)) for target, _ in running]
    together = {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
    order = np.lexsort((together["row"], together["block"]))
    return {key: value[order] for key, value in together.items()}


if __name__ == "__main__":
    main()
