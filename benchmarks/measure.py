"""What every benchmark shares: fair timing, the machine's description, and results as JSON."""

import json
import os
import platform
import statistics
import time
from collections.abc import Callable, Mapping
from importlib import metadata
from pathlib import Path

# Solving small systems on several threads costs more than it gains: they wait for one another, spinning.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax

RESULTS = Path(__file__).parent / "results"


def seconds(call: Callable, *, repeats: int = 7, least: float = 0.02) -> float:
    """Median wall time of one call, outputs waited for, after a warm-up; short calls are looped to `plan_margin`
    seconds."""
    return compare({"": call}, repeats=repeats, least=least)[""]


def compare(calls: Mapping[str, Callable], *, repeats: int = 7, least: float = 0.02) -> dict[str, float]:
    """Median wall times of several calls, taken in turn so that a noisy machine disturbs all of them alike."""
    loops = {}
    for name, call in calls.items():
        jax.block_until_ready(call())
        begun = time.perf_counter()
        jax.block_until_ready(call())
        loops[name] = max(1, round(least / max(time.perf_counter() - begun, 1e-7)))
    taken: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(repeats):
        for name, call in calls.items():
            begun = time.perf_counter()
            for _ in range(loops[name]):
                jax.block_until_ready(call())
            taken[name].append((time.perf_counter() - begun) / loops[name])
    return {name: statistics.median(times) for name, times in taken.items()}


def machine() -> dict[str, str | int | None]:
    """The machine and the versions that a result belongs to."""
    named = ("jax", "diffrax", "numpy", "scipy", "numba", "casadi", "mujoco")
    versions = {name: metadata.version(name) for name in named if _installed(name)}
    model = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        names = (line.partition(":")[2].strip() for line in cpuinfo.read_text().splitlines() if "model name" in line)
        model = next(names, model)
    return {"cpu": model, "cores": os.cpu_count(), "python": platform.python_version(), **versions}


def save(name: str, result: Mapping) -> Path:
    """Write `results/NAME.json` with the machine beside the result."""
    RESULTS.mkdir(exist_ok=True)
    path = RESULTS / f"{name}.json"
    path.write_text(json.dumps({"machine": machine(), **result}, indent=1) + "\n")
    return path


def kept(name: str) -> dict:
    """The results that an earlier run has written, without its machine; none if none has."""
    path = RESULTS / f"{name}.json"
    results = json.loads(path.read_text()) if path.exists() else {}
    return {key: value for key, value in results.items() if key != "machine"}


def _installed(name: str) -> bool:
    try:
        metadata.version(name)
    except metadata.PackageNotFoundError:
        return False
    return True
