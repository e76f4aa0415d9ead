"""Files are written whole or not at all."""

import os
import uuid
from pathlib import Path


def write_atomically(path: str | Path, content: str | bytes) -> None:
    """Write a file beside its place and move it there once it is complete.

    A file that is replaced passes on its permissions, a new one has those that the process gives; behind a symbolic
    link it is the file that is written, not the link.
    """
    path = Path(path).resolve()
    data = content.encode() if isinstance(content, str) else content
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}")
    try:
        with open(temporary, "xb") as file:
            file.write(data)
        if path.exists():
            os.chmod(temporary, path.stat().st_mode)
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
