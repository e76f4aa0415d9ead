"""Claims of the documents: commands are ones that the program knows, measured numbers name what makes them."""

import importlib
import re
import shlex
from pathlib import Path

import pytest
import typer

import wholearm_jax as wa
from wholearm_jax.cli.app import app
from wholearm_jax.core import Status

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")), ROOT / "benchmarks" / "README.md"]
MEASURED_PAGES = ("performance.md", "checking.md", "execution.md", "accuracy.md")
COMMANDS: dict = vars(typer.main.get_command(app))["commands"]
OPTIONS = {option for command in COMMANDS.values() for parameter in command.params for option in parameter.opts}
OPTIONS |= {
    option for command in COMMANDS.values() for parameter in command.params for option in parameter.secondary_opts
}
OTHER_OPTIONS = {"--quick", "--version", "--json", "--help"}  # of the benchmarks, and of the program itself
VALUES = {
    "SECONDS": "1",
    "NEWTONS": "0.5",
    "N": "3",
    "K": "0",
    "Q=A": "mass=5%",
    "...": "x=0.01",
    "PHASE.duration=1": "0.duration=1",
}
MEASURED = re.compile(r"\d (?:of the (?:time|prediction)|times (?:as|the|that)|m?s\b|GiB|mm of|plans|%)")
# Numbers that are settings, definitions or advice on these pages, not measured.
NOT_MEASURED = ("--", "arrival within", "default", "success:", "cache", "`tolerance")


def written_commands():
    """Yield each command of an indented line: page, and its words without brackets, comments and descriptions."""
    for page in PAGES:
        for line in re.findall(r"^ {4}(.*wholearm \w.*)$", page.read_text(), re.MULTILINE):
            for part in re.split(r" && |  +| # ", line):
                found = re.match(r"(?:\S*/)?wholearm (\w.*)", part)
                if found:
                    yield page.name, found[1].replace("[", "").replace("]", "")


WRITTEN = sorted(set(written_commands()))


def test_commands_are_found():
    assert len(WRITTEN) >= 25
    assert {text.split()[0] for _, text in WRITTEN} == set(COMMANDS)


@pytest.mark.parametrize(("page", "text"), WRITTEN, ids=[f"{page}: {text}" for page, text in WRITTEN])
def test_commands_are_parsed(page, text):
    name, *words = [VALUES.get(word, word) for word in shlex.split(text)]
    COMMANDS[name].make_context(name, words)  # parses and converts, and runs nothing


def test_commands_and_options_in_sentences_exist():
    seen = 0
    for page in PAGES:
        for code in re.findall(r"`([^`\n]+)`", page.read_text()):
            command = re.match(r"wholearm (\w+)", code)
            assert command is None or command[1] in COMMANDS, code
            for option in re.findall(r"(?<!\S)--[a-z][\w-]*", code) if code.startswith(("wholearm", "--")) else ():
                assert option in OPTIONS | OTHER_OPTIONS, (page.name, option)
                seen += 1
    assert seen >= 30


@pytest.mark.parametrize("name", MEASURED_PAGES)
def test_measured_numbers_name_what_makes_them(name):
    """A paragraph, an item or a row with a measured number names a benchmark whose results are kept, or a test."""
    text = re.sub(r"```.*?```", "", (ROOT / "docs" / name).read_text(), flags=re.DOTALL)
    blocks = re.split(r"\n\n|\n(?= *- |\|)", text)
    claims = [block for block in blocks if MEASURED.search(block) and not any(word in block for word in NOT_MEASURED)]
    for block in claims:
        scripts = re.findall(r"`(?:benchmarks/)?(\w+)\.py`|`benchmarks/(\w+)/`|(notebook \d)", block)
        named = [next(filter(None, groups)) for groups in scripts]
        kept = [
            one for one in named if one.startswith("notebook") or (ROOT / "benchmarks/results" / f"{one}.json").exists()
        ]
        assert kept or re.search(r"`tests/[\w/]+\.py`|a test\b|\| tests \|", block), block


def test_the_page_on_statuses_has_every_cause_of_the_advice():
    page = (ROOT / "docs" / "statuses.md").read_text()
    assert all(f"| `{status.label}` |" in page for status in Status)
    source = (ROOT / "wholearm_jax" / "optimisation" / "advice.py").read_text()
    flags = set(re.findall(r"--(?!set)[a-z-]+", source))
    assert len(flags) >= 3
    assert [flag for flag in flags if flag not in page] == []


def test_names_in_the_code_of_pages_exist():
    """`wa.NAME`, and `wholearm_jax.FOLDER.NAME` but for paths of files."""
    seen = 0
    for page in PAGES:
        if page.name == "glossary.md":  # which has a test of its own
            continue
        text = page.read_text()
        for name in re.findall(r"\bwa\.([a-z_]\w*)", text):
            assert hasattr(wa, name), (page.name, name)
            seen += 1
        for dotted in re.findall(r"\bwholearm_jax((?:\.\w+)+)", text):
            value = wa
            for part in dotted.strip(".").split("."):
                found = getattr(value, part, None)
                value = importlib.import_module(f"{value.__name__}.{part}") if found is None else found
        for folder, names in re.findall(r"from wholearm_jax\.(\w+) import (.+)", text):
            module = importlib.import_module(f"wholearm_jax.{folder}")
            assert all(hasattr(module, name.strip()) for name in names.split(",")), page.name
    assert seen >= 40
