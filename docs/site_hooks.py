"""Hooks of the documentation site: pages from other folders of the repository, and formulas without scripts."""

import html
import re
from pathlib import Path

from latex2mathml.converter import convert
from mkdocs.structure.files import File

ROOT = Path(__file__).parents[1]
OUTSIDE = (
    "CHANGELOG.md",
    "CONTRIBUTING.md",
    "notebooks/*.md",
    "notebooks/*.ipynb",
    "notebooks/figures/*.png",
    "benchmarks/*.md",
    "benchmarks/results/*.svg",
    "tests/*.md",
    "examples/*.py",
)
FORMULA = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.DOTALL)


def on_files(files, config):
    """Add the pages that lie beside `docs/`, at the same paths within the site."""
    for pattern in OUTSIDE:
        for path in sorted(ROOT.glob(pattern)):
            files.append(File.generated(config, path.relative_to(ROOT).as_posix(), abs_src_path=str(path)))
    return files


def on_page_markdown(markdown, page, config, files):
    """Lead relative links, written for the repository, to the same pages of the site."""
    if page.file.abs_src_path and Path(page.file.abs_src_path).is_relative_to(ROOT / "docs"):
        return re.sub(r"\]\((\.\./)*\.\./(?=\w)", r"](\1", markdown)
    return re.sub(r"\]\(((?:\.\./)?)docs/", r"](\1", markdown)


def on_page_content(content, page, config, files):
    """Turn LaTeX into MathML, which browsers set by themselves: no script, no network."""

    def formula(match):
        kind, latex = match.groups()
        return convert(html.unescape(latex), display="block" if kind == "div" else "inline")

    return FORMULA.sub(formula, content)
