"""Every benchmark runs: its smallest part, in a process of its own, writing nothing that is kept."""

import os
import subprocess
import sys
from pathlib import Path

import jax
import pytest

from wholearm_jax.core.executable_cache import MIN_CACHED_COMPILE_TIME

ROOT = Path(__file__).parents[2]
RUNS = {  # what each runs, after `import NAME as module`
    "batch": "module.COUNTS = (8, 8); run('--quick')",
    "best_motions": "module.PROGRAMME_INTERVALS = 40; run('--count', '1', '--durations', '1.0')",
    "cold_start": "run('--quick')",
    "collocation": "run('heptagon', '--knots', '8')",
    "cost_against": "run('HEAD', '--turns', '1')",
    "exhaustive_planning": "run('--quick')",
    "execution": "module.SCENES, module.STEPS = ('heptagon',), (1.6e-3, 8e-4); run('--quick')",
    "feedback": "module.SETS = dict([*module.SETS.items()][:1]); run('--quick', '--scenes', 'heptagon')",
    "flying_plans": "run('--count', '1', '--phases', '2')",
    "gradients": "module.KNOTS, module.TOLERANCES = (4,), (1e-4,); run('--quick')",
    "interruption": "run('--runs', '1', '--latest', '3')",
    "optimisation": "module.random_plans = lambda *_: (); run('--quick')",
    "planning": "module.PLANNERS = {'rolling': {}, 'random tree': None}; run('--quick'); "
    "module.bundled = lambda: ['tipping']; run('--quick', '--rates')",
    "plan_executions": "run('--quick')",
    "prediction": "module.SORTS, module.TIMESTEP = {'stopping': 1}, 4e-4; run('--quick', '--seeds', '0')",
    "random_plans": "run('--count', '1', '--phases', '1')",
    "shortest_times": "run('--quick')",
    "skipping": "module.problems = lambda **_: PROBLEMS(referred=False)[:1]; run('--quick')",
    "work_precision": "print(module.in_turn(PROBLEMS(referred=False)[0], 'Dopri8', 1e-7, 1))",
}
QUICK = ("collocation", "interruption", "planning", "random_plans")
NEEDS = {
    "collocation": "casadi",
    "optimisation": "casadi",
    "shortest_times": "toppra",
    "skipping": "numba",
    "work_precision": "numba",
}
PRELUDE = """
import sys, jax, wholearm_jax
# Compiled as the tests are, whose programs are kept: benchmarks that time compiling keep none.
configure, update = wholearm_jax.configure, jax.config.update
wholearm_jax.configure = lambda **_: configure()
jax.config.update = lambda name, value: name == "jax_enable_compilation_cache" or update(name, value)
import {name} as module
PROBLEMS = getattr(module, "problems", None)
def run(*arguments):
    sys.argv = ["{name}.py", *arguments]
    module.main()
"""
SWEEP = """
from pathlib import Path
import numpy as np
from benchmarks.stability import sweep
configure, draw = sweep.configure, sweep.draw
sweep.configure = lambda **_: configure()  # as the tests are compiled
sweep.BLOCK, sweep.check_gradients = 4, lambda *_: None  # gradients compile longest, and have tests of their own
sweep.draw = lambda *of: draw(*of)._replace(stepped=np.ones(4, bool))  # one program serves schedules with steps or not
level = sweep.DOUBLE.levels[0]._replace(lanes=4)
sweep.DOUBLE = sweep.DOUBLE._replace(levels=(level,))
sweep.work([0], 1, single=False, target=Path("records.npz"))
"""


def test_every_script_is_run():
    scripts = {path.stem for path in (ROOT / "benchmarks").glob("*.py") if "def main(" in path.read_text()}
    assert scripts == set(RUNS)
    folders = {path.parent.name for path in (ROOT / "benchmarks").glob("*/__main__.py")}
    assert folders == {"stability"}


@pytest.mark.parametrize("name", [pytest.param(name, marks=() if name in QUICK else pytest.mark.slow) for name in RUNS])
def test_benchmark_runs_on_its_smallest_part(name, tmp_path):
    pytest.importorskip(NEEDS.get(name, "numpy"))
    assert run_apart(PRELUDE.format(name=name) + RUNS[name], tmp_path)


@pytest.mark.slow
def test_the_stability_sweep_runs_on_a_few_scenes(tmp_path):
    assert "block 0:" in run_apart(SWEEP, tmp_path)
    assert (tmp_path / "records.npz").exists()


def run_apart(program, folder):
    """Run a program in a process of its own, with the programs that are kept; return what it prints."""
    paths = [str(ROOT / "benchmarks"), str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
    kept = {
        "JAX_COMPILATION_CACHE_DIR": str(jax.config.values["jax_compilation_cache_dir"]),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": str(MIN_CACHED_COMPILE_TIME),
    }
    environment = os.environ | kept | {"PYTHONPATH": os.pathsep.join(paths), "MPLBACKEND": "agg"}
    command = [sys.executable, "-c", program]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=1200)
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout.strip()
