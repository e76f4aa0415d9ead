"""Documents: public examples run; cited sections, linked files and named code exist; statuses agree; a short README."""

import ast
import doctest
import importlib
import inspect
import re
from pathlib import Path

import pytest

import wholearm_jax as wa
from wholearm_jax.core import Status
from wholearm_jax.files import scene_schema

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "wholearm_jax"
DOCS = ROOT / "docs"
MODULES = sorted(PACKAGE.rglob("*.py"))
FOLDERS = sorted(path.parent.name for path in PACKAGE.glob("*/__init__.py"))
PAGES = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")),
    *sorted(DOCS.rglob("*.md")),
    *(ROOT / name / "README.md" for name in ("notebooks", "benchmarks", "tests")),
]
# What is made by, or given to, those that have one; and what takes long to compile and is tested by itself.
WITHOUT_EXAMPLE = {
    "Controller",
    "IntegratorOptions",
    "TorqueSchedule",
    "check",
    "feedback",
    "plan",
    "plan_with_hand",
    "write_controller",
}


def defined_names() -> set[str]:
    """Top-level names of every module of the package, parameters of functions, and `Class.member` of every class."""
    names = set()
    for path in MODULES:
        for node in ast.parse(path.read_text()).body:
            targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
            names |= {n.id for target in targets if target for n in ast.walk(target) if isinstance(n, ast.Name)}
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                names.add(node.name)
            for inner in ast.walk(node):
                if isinstance(inner, ast.arg):
                    names.add(inner.arg)
            for member in node.body if isinstance(node, ast.ClassDef) else ():
                if isinstance(member, ast.AnnAssign) and isinstance(member.target, ast.Name):
                    names |= {member.target.id, f"{node.name}.{member.target.id}"}
                if isinstance(member, ast.FunctionDef):
                    names.add(f"{node.name}.{member.name}")
    return names


def test_the_files_that_these_tests_read_are_all_there():
    assert len(FOLDERS) >= 15
    assert len(MODULES) > 80
    assert len(list(DOCS.glob("*.md"))) >= 13
    assert len(list((DOCS / "api").glob("*.md"))) == len(FOLDERS) + 1
    assert all(path.exists() for path in PAGES)


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


def test_readme_is_short():
    assert len((ROOT / "README.md").read_text().split()) <= 900


def test_every_status_has_a_row_that_agrees():
    table, exit_statuses = (DOCS / "statuses.md").read_text().split("## Exit status")
    rows = dict(re.findall(r"^\| `(\w+)` \| ([^|]+) \|", table, re.MULTILINE))
    assert rows == {status.label: status.advice for status in Status}
    assert "`optimise`" in exit_statuses


def test_the_page_on_scene_files_has_every_key():
    rows = re.findall(r"^\| ((?:`[\w.]+`(?:, )?)+) \|", (DOCS / "scenes.md").read_text(), re.MULTILINE)
    keys = [key for row in rows for key in re.findall(r"`([\w.]+)`", row)]
    models = scene_schema.SceneTables, scene_schema.FingerTable, scene_schema._Object, scene_schema.PhaseTable
    known = [name for model in models for name in model.model_fields if name != "hand"]
    assert sorted(keys) == sorted([*known, *(f"hand.{name}" for name in scene_schema._Hand.model_fields)])


def test_sections_that_the_code_cites_exist():
    sections = set(re.findall(r"^## (\d+)\.", (DOCS / "derivation.md").read_text(), re.MULTILINE))
    assert len(sections) >= 11
    texts = {path: path.read_text() for path in [*MODULES, *PAGES]}
    citing = 0
    for path, text in texts.items():
        for cited in re.findall(r"[Dd]erivation(?:\]\([^)]*\))?[,:] sections? (\d+)(?: and (\d+))?", text):
            assert set(cited) - {""} <= sections, path
            citing += 1
    assert citing > 20


def test_modules_that_the_derivation_names_exist():
    named = re.findall(r"[Mm]odules? ((?:`[\w/]+`(?:, )?)+)", (DOCS / "derivation.md").read_text())
    modules = {name for group in named for name in re.findall(r"`([\w/]+)`", group)}
    assert len(modules) >= 20
    paths = {path.relative_to(PACKAGE).with_suffix("").as_posix() for path in MODULES}
    assert modules <= paths


def test_names_of_the_glossary_exist():
    rows = re.findall(r"^\|[^|]*\|[^|]*\|([^|]*)\|$", (DOCS / "glossary.md").read_text(), re.MULTILINE)
    named = {name for row in rows for name in re.findall(r"`([\w.]+)`", row)}
    assert len(named) >= 100
    assert named <= defined_names() | set(wa.__all__)


def test_every_class_that_a_folder_offers_is_in_the_glossary():
    named = set(re.findall(r"`([\w.]+)`", (DOCS / "glossary.md").read_text()))
    named |= {name.partition(".")[0] for name in named}
    offered = {
        name
        for folder in FOLDERS
        for name, value in vars(importlib.import_module(f"wholearm_jax.{folder}")).items()
        if isinstance(value, type) and value.__module__.startswith("wholearm_jax.")
    }
    assert len(offered) >= 30
    assert sorted(offered - named) == []


def test_new_names_of_the_changes_exist():
    rows = re.findall(r"^\|[^|]*\|([^|]*)\|$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    named = {name for row in rows for name in re.findall(r"`([\w.]+)", row)}
    assert len(named) >= 60
    folders = {f"wholearm_jax.{name}" for name in FOLDERS}
    loose = {name.removeprefix("wa.") for name in named if name.partition(".")[0] != "wholearm_jax"}
    assert loose <= defined_names() | set(wa.__all__)
    for name in named - loose - folders:
        folder, _, attribute = name.removeprefix("wa.").rpartition(".")
        if folder.startswith("wholearm_jax"):
            assert hasattr(importlib.import_module(folder), attribute), name


def test_old_names_of_the_root_lead_to_the_new_ones():
    table = (ROOT / "CHANGELOG.md").read_text().split("### `import wholearm_jax as wa`")[1].split("###")[0]
    rows = re.findall(r"^\| `wa\.(\w+)(?:\(\.\.\.\))?` \| `wa\.(\w+)", table, re.MULTILINE)
    assert dict(rows) == wa._RENAMED
    assert len(wa._RENAMED) == 4
    for old, new in wa._RENAMED.items():
        assert old not in wa.__all__
        with pytest.warns(FutureWarning, match=rf"wholearm_jax\.{old} is now wholearm_jax\.{new} "):
            assert getattr(wa, old) is getattr(wa, new)
    with pytest.raises(AttributeError, match="no attribute 'wire'"):
        _ = wa.wire


def test_the_page_of_benchmarks_has_every_script():
    table = (ROOT / "benchmarks" / "README.md").read_text().split("| script | compares |")[1].split("\n\n")[0]
    named = re.findall(r"`([\w./]+)`", "".join(re.findall(r"^\|([^|]*)\|", table, re.MULTILINE)))
    scripts = [path.name for path in (ROOT / "benchmarks").glob("*.py")]
    assert sorted(named) == sorted([*scripts, "stability/"])


def test_symbols_of_the_glossary_are_given_once():
    rows = re.findall(r"^\| ([^|]+) \|[^|]*\| `", (DOCS / "glossary.md").read_text(), re.MULTILINE)
    symbols = [row.strip() for row in rows if row.strip()]
    assert len(symbols) >= 30
    assert len(symbols) == len(set(symbols))


def test_pages_on_the_layout_name_every_folder():
    page = (DOCS / "architecture.md").read_text()
    assert [name for name in FOLDERS if f"      {name}/ " not in page or f"| `{name}` |" not in page] == []
    assert sorted(path.stem for path in (DOCS / "api").glob("*.md")) == sorted(["README", *FOLDERS])


def test_the_table_of_places_names_functions_of_its_modules():
    table = (DOCS / "architecture.md").read_text().split("## Where is")[1].split("\n## ")[0]
    rows = re.findall(r"^\|[^|]*\|([^|]*)\|([^|]*)\|$", table, re.MULTILINE)
    assert len(rows) >= 25
    for modules, functions in rows[2:]:
        paths = [PACKAGE / name for name in re.findall(r"`(\w+/\w+\.py)`", modules) if name != "cli/NAME.py"]
        names = re.findall(r"`(\w+)`", functions)
        assert paths
        assert names
        defined = {n.name for path in paths for n in ast.parse(path.read_text()).body if isinstance(n, ast.FunctionDef)}
        assert set(names) <= defined, modules


def test_files_that_documents_and_docstrings_cite_exist():
    """`tests/...`, `benchmarks/...`, `docs/...` in backticks, in pages and in the code; modules as `folder/name.py`."""
    cited = {
        (path, name)
        for path in [*MODULES, *PAGES]
        if path.name != "CHANGELOG.md"
        for name in re.findall(r"`((?:tests|benchmarks|docs|examples|notebooks)/[\w./-]+)`", path.read_text())
    }
    assert len(cited) >= 8
    assert [(str(path), name) for path, name in cited if not (ROOT / name).exists()] == []
    package_folders = "|".join(FOLDERS)
    modules = {
        (path, name)
        for path in PAGES
        for name in re.findall(rf"`((?:{package_folders})/[\w/]+\.py)`", path.read_text())
        if not name.endswith("/NAME.py")
    }
    assert len(modules) >= 8
    assert [(str(path), name) for path, name in modules if not (PACKAGE / name).exists()] == []


@pytest.mark.parametrize("path", PAGES, ids=lambda path: str(path.relative_to(ROOT)))
def test_links_lead_somewhere(path):
    links = re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", path.read_text())
    assert links or DOCS in path.parents
    for link in links:
        assert link.startswith("http") or (path.parent / link).exists(), link
