"""The README's Python lines run as they stand."""

import re
from pathlib import Path

import matplotlib
import numpy as np


def test_the_python_lines_run(tmp_path, monkeypatch):
    matplotlib.use("agg")
    text = (Path(__file__).parents[1] / "README.md").read_text()
    code = re.search(r"```python\n(.*?)```", text, re.DOTALL)
    assert code is not None
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("JAX_ENABLE_COMPILATION_CACHE", "true")  # leave the user's cache folder alone
    names = {}
    exec(code.group(1), names)
    assert (tmp_path / "result.png").stat().st_size > 10_000
    assert names["optimum"].result.status.label == "ok"
    assert np.all(np.isfinite(names["slope"].object.vertices))
