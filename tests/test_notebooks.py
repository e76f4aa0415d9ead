"""Notebooks: each runs from its question to its figure without a complaint, and its kept outputs are small."""

import re
from pathlib import Path

import nbclient
import nbformat
import pytest

FOLDER = Path(__file__).parents[1] / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
LARGEST = 500_000  # bytes of a notebook with its outputs
SMALLER = {  # what the tests put in the place of sizes that a notebook's first cell names
    "3_descent": {"GRID": "(4, 4)", "DURATIONS": "np.array([0.3, 1.0])", "SAMPLES": "3", "FACTORS": "np.ones(1)"},
    "4_sensitivity": {"LENGTHS": "np.array([0.08, 0.09])"},
    "5_tolerance": {"PARTS": "40", "SPREAD": "4"},
    "6_execution": {"STEPS": "[1.6e-3, 8e-4]", "EXECUTIONS": "2"},
    "7_real_hand": {"EXECUTIONS": "1", "PUSHES": "[-0.1, 0.1]", "PUSHED_AT": "[0.4]", "STARTS": "[2e-3]"},
    "8_drawing": {"LENGTHS": "(0.1, 0.1)", "JOINTS": "(0.045, 0.045)", "STEP": "5e-4"},
}


@pytest.fixture(scope="module", autouse=True)
def compiled(request, tmp_path_factory):
    """Kernels keep their programs where the tests do, traced ones too, and not in the user's folder."""
    cache = getattr(request.config, "cache", None)  # None where pytest keeps none
    home = tmp_path_factory.mktemp("programs") if cache is None else cache.mkdir("programs")
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("MPLBACKEND", raising=False)  # the command line's choice, once a test has run it in this process
        patch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
        patch.setenv("XDG_CACHE_HOME", str(home))
        yield


def pictures(cell) -> int:
    return sum("image/png" in output.get("data", {}) for output in cell.get("outputs", ()))


def complaints(notebook) -> list[str]:
    """What cells wrote on their standard error."""
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", ())]
    return [output.text for output in outputs if output.output_type == "stream" and output.name == "stderr"]


def set_sizes(notebook, sizes: dict[str, str]) -> None:
    """Write to the end of the cell with the tag `parameters` what its names stand for instead."""
    (cell,) = [cell for cell in notebook.cells if "parameters" in cell.metadata.get("tags", ())]
    assert all(re.search(rf"^(\w+, )*{name}(, \w+)* = ", cell.source, re.MULTILINE) for name in sizes), (
        "an unknown size"
    )
    cell.source = "\n".join([cell.source, *(f"{name} = {value}" for name, value in sizes.items())])


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_runs(path, tmp_path):
    notebook = nbformat.read(path, as_version=4)
    if path.stem in SMALLER:
        set_sizes(notebook, SMALLER[path.stem])
    place = {"metadata": {"path": str(tmp_path)}}
    nbclient.NotebookClient(notebook, timeout=300, kernel_name="python3", resources=place).execute()
    assert complaints(notebook) == []
    assert list(tmp_path.iterdir()) == []
    kept = nbformat.read(path, as_version=4)
    assert [pictures(cell) for cell in notebook.cells] == [pictures(cell) for cell in kept.cells]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_what_is_kept(path):
    text, notebook = path.read_text(), nbformat.read(path, as_version=4)
    assert len(text) < LARGEST
    question, *_ = notebook.cells[0].source.splitlines()
    assert question.startswith("# ")
    assert question.endswith("?")
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert all(cell.execution_count for cell in code), "its outputs have not been kept"
    assert pictures(code[-1]), "it does not end in a figure"
    assert complaints(notebook) == []
    written = "".join(str(output) for cell in code for output in cell.outputs)
    assert not re.search(r"(?<![\w/])/(home|root|tmp|work|opt|usr)/", written), "an output names a path of a machine"
    after = zip(notebook.cells, notebook.cells[1:], strict=False)
    assert all(following.source.startswith("*Figure") for cell, following in after if pictures(cell)), "no caption"


def test_all_are_listed():
    listed = set(re.findall(r"\]\((\w+\.ipynb)\)", (FOLDER / "README.md").read_text()))
    assert listed == {path.name for path in NOTEBOOKS}
