"""Every benchmark runs: its smallest part, in a process of its own, writing nothing that is kept."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
RUNS = {
    "random_plans": "run('--count', '1', '--phases', '1')",
    "flying_plans": "run('--count', '1', '--phases', '2')",
    "execution": "module.SCENES, module.STEPS = ('heptagon',), (1.6e-3, 8e-4); run('--quick')",
}
PRELUDE = """
import sys, {name} as module
def run(*arguments):
    sys.argv = ["{name}.py", *arguments, "--out", {out!r}] if {takes_out} else ["{name}.py", *arguments]
    module.main()
"""


@pytest.mark.parametrize("name", RUNS)
def test_benchmark_runs_on_its_smallest_part(name, tmp_path):
    source = (ROOT / "benchmarks" / f"{name}.py").read_text()
    program = PRELUDE.format(name=name, out=str(tmp_path), takes_out='"--out"' in source) + RUNS[name]
    paths = [str(ROOT / "benchmarks"), str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths), "MPLBACKEND": "agg"}
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout.strip() or any(tmp_path.iterdir())
