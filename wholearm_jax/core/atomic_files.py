"""Files are written whole or not at all, alone or as a set."""

import os
import threading
import uuid
from collections.abc import Iterable, Mapping
from pathlib import Path

WRITING = threading.RLock()
"""Held while files are written: a process that ends itself waits for it, and so leaves no half of a set behind."""


def write_atomically(path: str | Path, content: str | bytes) -> None:
    """Write a file next to `path`, and move it there once it is complete.

    A file that is replaced passes on its permissions, a new one has those that the process gives; behind a symbolic
    link it is the file that is written, not the link.
    """
    path = Path(path)
    write_together(path.parent, {path.name: content})


def write_together(
    folder: Path, contents: Mapping[str, str | bytes], record: str | None = None, obsolete: Iterable[str] = ()
) -> None:
    """Write several files of a folder, each as `write_atomically` does, once all of them are complete.

    Until then, and after any error, the folder is as it was. A process that is killed while the files are moved leaves
    the folder without its `record`.

    Args:
        folder: an existing folder.
        contents: file name -> content.
        record: the name of the file that stands for the whole set: removed first, moved into place last.
        obsolete: names of earlier files to remove.
    """
    staged: list[tuple[Path, Path]] = []
    with WRITING:
        try:
            for name in sorted(contents, key=lambda name: name == record):
                staged.append(_stage(folder / name, contents[name]))
            stale = [folder / name for name in (record, *obsolete) if name and name not in contents]
            for path in ([folder / record] if record and len(staged) > 1 else []) + stale:
                path.unlink(missing_ok=True)
            for temporary, path in staged:
                os.replace(temporary, path)
        except BaseException:
            for temporary, _ in staged:
                temporary.unlink(missing_ok=True)
            raise


def _stage(path: Path, content: str | bytes) -> tuple[Path, Path]:
    """Write `content` next to the file that `path` leads to; return where it is, and where it belongs."""
    path = path.resolve()
    if path.is_dir():
        raise IsADirectoryError(21, "Is a directory", str(path))
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}")
    try:
        with open(temporary, "xb") as file:
            file.write(content.encode() if isinstance(content, str) else content)
        if path.exists():
            os.chmod(temporary, path.stat().st_mode)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    return temporary, path
