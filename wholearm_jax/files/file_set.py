"""Files that belong together: a result's, an execution's. They are replaced as a set, or stay as they were."""

import json
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from wholearm_jax.core import write_together


class FileSet(NamedTuple):
    """The files that a command may write into a folder, some of them on request only."""

    record: str | None  # a JSON object with a `status`, there when the set is complete; None: figures alone
    others: tuple[str, ...]
    figures: tuple[str, ...]  # without their suffixes

    @property
    def names(self) -> tuple[str, ...]:
        """The names of all files but the record."""
        return *self.others, *(f"{name}.{kind}" for name in self.figures for kind in ("png", "svg", "pdf"))


RESULT_FILES = FileSet(
    "summary.json", ("torque.csv", "trajectory.csv", "controller.json", "report.html"), ("plan", "result")
)
EXECUTION_FILES = FileSet("execution.json", ("execution.csv", "execution.gif", "model.xml"), ("execution", "frames"))


@contextmanager
def replace_files(folder: Path, files: FileSet) -> Iterator[Path]:
    """Yield a scratch folder to write into; what is there at the end takes the place of the set's earlier files.

    Files of two results beside each other would mislead: those that are not written again are removed. After an
    exception the folder is as it was.
    """
    with tempfile.TemporaryDirectory() as scratch:
        yield Path(scratch)
        contents = {path.name: path.read_bytes() for path in Path(scratch).iterdir()}
        write_together(folder, contents, files.record, files.names)


def is_ok(folder: Path, files: FileSet) -> bool:
    """Return whether a folder holds a set whose record says `ok`."""
    try:
        record = json.loads((folder / (files.record or "")).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return False
    return isinstance(record, dict) and record.get("status") == "ok"
