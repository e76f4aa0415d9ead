"""Notebooks: each runs from its question to its figure without a complaint, and its kept outputs are small."""

import re
from pathlib import Path

import jax
import nbclient
import nbformat
import pytest

FOLDER = Path(__file__).parents[1] / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
LARGEST = 500_000  # bytes of a notebook with its outputs


@pytest.fixture(scope="module", autouse=True)
def compiled():
    """Kernels share the tests' compiled programs."""
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("MPLBACKEND", raising=False)  # the command line's choice, once a test has run it in this process
        patch.setenv("JAX_COMPILATION_CACHE_DIR", jax.config.values["jax_compilation_cache_dir"])
        patch.setenv("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.2")
        yield


def pictures(cell) -> int:
    return sum("image/png" in output.get("data", {}) for output in cell.get("outputs", ()))


def complaints(notebook) -> list[str]:
    """What cells wrote on their standard error."""
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", ())]
    return [output.text for output in outputs if output.output_type == "stream" and output.name == "stderr"]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_runs(path, tmp_path):
    notebook = nbformat.read(path, as_version=4)
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
