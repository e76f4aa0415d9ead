"""Documents: every example in a public docstring runs, every cited section and linked file exists, statuses agree."""

import doctest
import inspect
import re
from pathlib import Path

import pytest

import wholearm_jax as wa
from wholearm_jax.core.status import Status
from wholearm_jax.files import scene_toml as scene_file

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "wholearm_jax"
PAGES = [ROOT / "README.md", *(ROOT / "docs").glob("*.md"), ROOT / "notebooks" / "README.md"]
# What is made by, or given to, those that have one; and what takes long to compile and is tested by itself.
WITHOUT_EXAMPLE = {"IntegratorOptions", "TorqueSchedule", "check"}


@pytest.mark.parametrize("name", wa.__all__)
def test_examples_in_docstrings_run(name, tmp_path):
    text = inspect.getdoc(getattr(wa, name))
    assert text, f"{name} has no docstring"
    example = doctest.DocTestParser().get_doctest(text, {"wa": wa, "folder": tmp_path}, name, None, None)
    assert example.examples or name in WITHOUT_EXAMPLE
    printed = []
    runner = doctest.DocTestRunner()
    result = runner.run(example, out=printed.append)
    assert result.failed == 0, "".join(printed)


def test_every_status_has_a_row_that_agrees():
    rows = dict(re.findall(r"^\| `(\w+)` \| ([^|]+) \|", (ROOT / "docs" / "statuses.md").read_text(), re.MULTILINE))
    assert rows == {status.label: status.advice for status in Status}


def test_the_page_on_scene_files_has_every_key():
    rows = re.findall(r"^\| ((?:`[\w.]+`(?:, )?)+) \|", (ROOT / "docs" / "scenes.md").read_text(), re.MULTILINE)
    told = [key for row in rows for key in re.findall(r"`([\w.]+)`", row)]
    models = scene_file._Scene, scene_file._Finger, scene_file._Object, scene_file._Phase
    known = [name for model in models for name in model.model_fields if name != "hand"]
    assert sorted(told) == sorted([*known, *(f"hand.{name}" for name in scene_file._Hand.model_fields)])


def test_sections_that_the_code_cites_exist():
    sections = set(re.findall(r"^## (\d+)\.", (ROOT / "docs" / "derivation.md").read_text(), re.MULTILINE))
    texts = {path: path.read_text() for path in [*PACKAGE.rglob("*.py"), *PAGES]}
    citing = 0
    for path, text in texts.items():
        for cited in re.findall(r"[Dd]erivation[,:] sections? (\d+)(?: and (\d+))?", text):
            assert set(cited) - {""} <= sections, path
            citing += 1
    assert citing > 12


def test_modules_that_the_derivation_names_exist():
    named = re.findall(r"[Mm]odules? ((?:`\w+`(?:, )?)+)", (ROOT / "docs" / "derivation.md").read_text())
    modules = {name for group in named for name in re.findall(r"`(\w+)`", group)}
    assert len(modules) >= 10
    assert modules <= {path.stem for path in PACKAGE.rglob("*.py")}


@pytest.mark.parametrize("path", PAGES, ids=lambda path: str(path.relative_to(ROOT)))
def test_links_lead_somewhere(path):
    links = re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", path.read_text())
    assert links or path.parent.name == "docs"
    for link in links:
        assert link.startswith("http") or (path.parent / link).exists(), link
