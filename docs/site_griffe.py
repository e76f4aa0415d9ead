"""Extension of the API pages: examples in docstrings are shown as code wherever they stand."""

import inspect
import re

import griffe


class DoctestSections(griffe.Extension):
    """Put every paragraph of a docstring that begins with a prompt into a section of examples."""

    def on_object(self, *, obj, **_):
        if obj.docstring and ">>>" in obj.docstring.value:
            paragraphs = re.split(r"\n\s*\n", inspect.cleandoc(obj.docstring.value))
            obj.docstring.value = "\n\n".join(map(_section, paragraphs))


def _section(paragraph: str) -> str:
    lines = paragraph.split("\n")
    return "\n".join(["Examples:", *(f"    {line}" for line in lines)]) if lines[0].startswith(">>>") else paragraph
