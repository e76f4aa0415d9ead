"""What a new process costs: from its start to the first result, with nothing compiled before and with programs kept.

    python benchmarks/cold_start.py [--repeats N] [--gradient]

Each run is a process of its own, as a user starts it: `first` is when it prints its first result, `exit` when files and
figures are written, too. With an empty cache folder everything is compiled; the second run finds the first one's
programs there. `apart` splits one more process of each kind by what JAX itself reports:
importing, tracing Python into programs and lowering them (threads overlap, so that parts may sum to more than the
whole), compiling, reading kept programs, and the rest (figures, files, the computation). `plain` leaves the choice of
emitters to XLA, and is otherwise compiled as by the command line. Beside the commands stands a first gradient in
Python, `equinox.filter_grad(wa.margin)` of the heptagon's plan with respect to its scene; `--gradient` measures that
alone, and leaves the other results as they are kept.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import matplotlib.pyplot as plt
import measure
from layered_scenes import layered_file

COMMANDS = {
    "optimise": ("optimise", str(layered_file("heptagon"))),
    "search": ("search", str(layered_file("heptagon"))),
    "simulate": ("simulate", str(layered_file("heptagon"))),
}
PLAIN = "--xla_cpu_use_fusion_emitters=true"
PARTS = ("import", "trace", "lower", "compile", "read kept programs")
COLOURS = ("#0072B2", "#56B4E9", "#009E73", "#D55E00", "#CC79A7")

APART = """
import json, sys, time
begun = time.perf_counter()
import jax
from wholearm_jax.cli.app import main
import wholearm_jax
spent = {"import": time.perf_counter() - begun}
names = {
    "/jax/core/compile/jaxpr_trace_duration": "trace",
    "/jax/core/compile/jaxpr_to_mlir_module_duration": "lower",
    "/jax/core/compile/backend_compile_duration": "compile",
    "/jax/compilation_cache/cache_retrieval_time_sec": "read kept programs",
}
def listen(event, seconds, **_):
    if event in names:
        spent[names[event]] = spent.get(names[event], 0.0) + seconds
jax.monitoring.register_event_duration_secs_listener(listen)
sys.argv = ["wholearm", *sys.argv[1:]]
try:
    main()
except SystemExit:
    pass
# What is read from the cache is reported as compiled, too.
spent["compile"] = spent.get("compile", 0.0) - spent.get("read kept programs", 0.0)
spent["whole"] = time.perf_counter() - begun
print(json.dumps(spent))
"""

GRADIENT = """
import sys
from pathlib import Path
import equinox as eqx
import wholearm_jax as wa
from wholearm_jax.core import keep_compiled
keep_compiled(Path(sys.argv[1]))
wa.configure()
slope = eqx.filter_grad(wa.margin)(wa.load(Path(sys.argv[2])), wa.read_torque(sys.argv[3]))
print(float(slope.hand.length.sum()))
"""


def environment(cache: Path, flags: str = "") -> dict[str, str]:
    """A user's environment: the command line's own cache, in a folder of its own."""
    mine = {k: v for k, v in os.environ.items() if not k.startswith(("JAX_", "XLA_", "OPENBLAS_"))}
    return mine | {"XDG_CACHE_HOME": str(cache)} | ({"XLA_FLAGS": flags} if flags else {})


def timed(command, surroundings: dict[str, str]) -> dict[str, float]:
    """Wall times [s] of one process: to the first line that it prints, and to its exit."""
    begun = time.perf_counter()
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, env=surroundings, **pipes) as process:
        line = process.stdout.readline()
        first = time.perf_counter() - begun
        _, complaints = process.communicate()
    if process.returncode == 2 or not line:
        raise RuntimeError(complaints)
    return {"first": first, "exit": time.perf_counter() - begun}


def run(arguments, cache: Path, out: Path, flags: str = "") -> dict[str, float]:
    """The times of a command of the package, whose first line is the first phase's."""
    command = [sys.executable, "-u", "-m", "wholearm_jax", *arguments, "--out", str(out)]
    return timed(command, environment(cache, flags))


def apart(arguments, cache: Path, out: Path) -> dict[str, float]:
    """Where one process's time goes [s]."""
    command = [sys.executable, "-c", APART, *arguments, "--out", str(out)]
    done = subprocess.run(command, env=environment(cache), capture_output=True, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def measured(name: str, arguments, repeats: int, torque: Path) -> dict:
    """Cold and kept times of one command, in turn."""
    arguments = (*arguments, "--torque", str(torque)) if name == "simulate" else arguments
    cold, kept, plain = [], [], []
    with tempfile.TemporaryDirectory() as folder:
        for k in range(repeats):
            cache, out = Path(folder, f"cache{k}"), Path(folder, "out")
            cold.append(run(arguments, cache, out))
            kept.append(run(arguments, cache, out))
            plain.append(run(arguments, Path(folder, f"plain{k}"), out, PLAIN))
        fresh = Path(folder, "apart")
        parts = {"cold": apart(arguments, fresh, out), "kept": apart(arguments, fresh, out)}
    runs = {"cold": cold, "kept": kept, "plain": plain}
    medians = {
        kind: {until: statistics.median(one[until] for one in several) for until in ("first", "exit")}
        for kind, several in runs.items()
    }
    return {"seconds": medians, "runs": runs, "apart": parts}


def first_gradient(repeats: int, torque: Path) -> dict[str, dict[str, float]]:
    """Wall times [s] from a process's start to the gradient that it prints: nothing compiled, then programs kept."""
    times: dict[str, list[float]] = {"cold": [], "kept": []}
    with tempfile.TemporaryDirectory() as folder:
        for k in range(repeats):
            given = Path(folder, f"cache{k}"), layered_file("heptagon"), torque
            command = [sys.executable, "-u", "-c", GRADIENT, *map(str, given)]
            for kind in times:
                times[kind].append(timed(command, environment(Path(folder)))["first"])
    seconds = {kind: statistics.median(several) for kind, several in times.items()}
    print(f"first gradient: {seconds['cold']:.1f} s, programs kept {seconds['kept']:.1f} s", flush=True)
    return {"seconds": seconds, "runs": times}


def draw(found: dict, path: Path) -> None:
    """Bars: the parts of every process."""
    plt.rcParams |= {"font.size": 8, "axes.spines.top": False, "axes.spines.right": False, "svg.fonttype": "none"}
    figure, ax = plt.subplots(figsize=(6.4, 0.5 + 0.5 * 2 * len(found)), layout="constrained")
    labels = []
    for name, result in found.items():
        for kind in ("cold", "kept"):
            left, parts = 0.0, result["apart"][kind]
            for part, colour in zip(PARTS, COLOURS, strict=True):
                width = parts.get(part, 0.0)
                ax.barh(len(labels), width, left=left, color=colour, label=part if not labels else None)
                left += width
            for until, stroke in (("first", ":"), ("exit", "-")):
                ends = [len(labels) - 0.45, len(labels) + 0.45]
                ax.plot([result["seconds"][kind][until]] * 2, ends, stroke, color="#222222", lw=2)
            labels.append(f"{name}, {kind}")
    ax.set_yticks(range(len(labels)), labels)
    ax.invert_yaxis()
    ax.set_xlabel("time [s]: parts, which overlap; from process start to the first result (dotted) and to exit (line)")
    ax.legend(frameon=False, loc="lower right")
    figure.savefig(path)
    plt.close(figure)


def tabulate(name: str, result: dict) -> None:
    """One command's times."""
    for kind, seconds in result["seconds"].items():
        print(f"{name}, {kind}: first result {seconds['first']:.1f} s, exit {seconds['exit']:.1f} s")
    for kind, parts in result["apart"].items():
        print(f"  {kind}: " + ", ".join(f"{part} {value:.1f}" for part, value in parts.items()), flush=True)


def main() -> None:
    """Measure, save, draw, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--quick", action="store_true", help="`simulate` alone, once; saves nothing")
    parser.add_argument("--gradient", action="store_true", help="the first gradient alone; other results stay")
    given = parser.parse_args()
    knots = Path(__file__).parent / "data" / "heptagon_knots.csv"
    if given.gradient:
        measure.save("cold_start", measure.kept("cold_start") | {"gradient": first_gradient(given.repeats, knots)})
        return
    with tempfile.TemporaryDirectory() as folder:
        if given.quick:
            torque = knots
            command = (*COMMANDS["simulate"], "--torque", str(torque))
            print("cold", run(command, Path(folder, "cache"), Path(folder, "out")))
            print("kept", apart(command, Path(folder, "cache"), Path(folder, "out")))
            return
        run(COMMANDS["optimise"], Path(folder, "cache"), Path(folder, "out"))
        torque = Path(folder, "out", "torque.csv")
        found = {}
        for name, command in COMMANDS.items():
            found[name] = measured(name, command, given.repeats, torque)
            tabulate(name, found[name])
    path = measure.save("cold_start", found | {"gradient": first_gradient(given.repeats, knots)})
    draw(found, path.with_suffix(".svg"))


if __name__ == "__main__":
    main()
