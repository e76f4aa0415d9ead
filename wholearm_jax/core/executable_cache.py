"""JAX's own cache of compiled programs: where it is, and what becomes of a damaged entry.

JAX warns of an entry that it cannot read, compiles the program, and leaves the entry as it is: each later process would
warn and compile again.
"""

import os
import re
import zlib
from pathlib import Path

import jax

from wholearm_jax.core.program_cache import enable_program_cache

MIN_CACHED_COMPILE_TIME = 0.0  # [s]: a process starts with dozens of small programs, which together take long
_UNREADABLE_ENTRY = re.compile(r"Error reading persistent compilation cache entry for '([^']*)'")

_own_folder: Path | None = None


def keep_compiled(folder: Path | None = None) -> None:
    """Keep compiled programs, and traced ones, in a folder, from this process and for later ones.

    Call it before JAX computes anything, next to `configure`: a later script or notebook then neither traces nor
    compiles what it shares with earlier ones.

    Args:
        folder: Where to. None: the folder of the command line, `~/.cache/wholearm_jax` (or below `XDG_CACHE_HOME`);
            where JAX's own settings name another folder for compiled programs, or none, these hold and nothing is done.

    >>> wa.keep_compiled()
    """
    global _own_folder
    if folder is None:
        if jax.config.values["jax_compilation_cache_dir"] is not None or "JAX_ENABLE_COMPILATION_CACHE" in os.environ:
            return
        folder = Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"), "wholearm_jax")
    _own_folder = folder
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", MIN_CACHED_COMPILE_TIME)
    enable_program_cache(folder / "programs")


def discard_unreadable_entry(warning: str) -> bool:
    """Delete the cache's entry that a warning of JAX is about, so that it is made anew; False for another warning."""
    match = _UNREADABLE_ENTRY.match(warning)
    if match is None or _own_folder is None:
        return False
    entries = list(_own_folder.glob(f"{match[1]}-*"))
    damaged = [path for path in entries if not _decompresses(path)]
    for path in damaged or entries:
        path.unlink(missing_ok=True)
    return True


def _decompresses(path: Path) -> bool:
    try:
        zlib.decompress(path.read_bytes())
    except (OSError, zlib.error):
        return False
    return True
