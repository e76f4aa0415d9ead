"""Examples: each runs as it stands, is short, and stands on the page of examples."""

import runpy
import sys
from pathlib import Path

import matplotlib
import pytest

ROOT = Path(__file__).parents[1]
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
PRINTED = {
    "1_trace": "path length 0.734 object radii",
    "2_optimise": "of the upper bound",
    "3_gradients": "after a small step along the gradient",
    "4_successors": "palm:v4 finger1:v6 finger2:v1 finger2:v2",
    "5_check": "rank correlation with the margin",
    "6_execute": "ok, ",
}


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_example_runs(path, tmp_path, monkeypatch, capsys):
    matplotlib.use("agg")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [str(path)])
    runpy.run_path(str(path), run_name="__main__")
    printed = capsys.readouterr()
    assert PRINTED[path.stem] in printed.out
    assert printed.err == ""
    if path.stem == "2_optimise":
        assert sorted(p.name for p in (tmp_path / "out").iterdir()) == [
            "forces.png",
            "plan.png",
            "result.png",
            "torque.csv",
        ]


def test_examples_are_few_short_and_shown():
    assert {path.stem for path in EXAMPLES} == set(PRINTED)
    page = (ROOT / "docs" / "examples.md").read_text()
    for path in EXAMPLES:
        assert len(path.read_text().splitlines()) <= 40
        assert f'--8<-- "examples/{path.name}"' in page
