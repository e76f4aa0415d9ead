"""The smallest program is kept; a damaged file of JAX's cache is made anew, and nothing is said of it."""

import os
import subprocess
import sys

import pytest

from wholearm_jax.core import executable_cache

PROGRAM = """
import jax, sys
from pathlib import Path
from wholearm_jax.cli.app import _handle_warnings
from wholearm_jax.core import keep_compiled
keep_compiled(Path(sys.argv[1]))
_handle_warnings()
print(float(jax.jit(lambda x: (x * x).sum())(jax.numpy.ones(30))))
"""


def run(folder):
    done = subprocess.run([sys.executable, "-c", PROGRAM, str(folder)], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "30.0"
    return done.stderr


DAMAGED = {
    "cut": lambda whole: whole[: len(whole) // 2],
    "a bit flipped": lambda whole: whole[:300] + bytes([whole[300] ^ 4]) + whole[301:],
}


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    folder = tmp_path_factory.mktemp("cache")
    assert run(folder) == ""
    return folder


@pytest.mark.parametrize("damage", DAMAGED.values(), ids=DAMAGED.keys())
def test_a_damaged_file_is_made_anew(damage, cache):
    (path,) = cache.glob("jit__lambda-*")
    whole = path.read_bytes()
    path.write_bytes(damage(whole))
    assert "Error reading" not in run(cache)
    assert len(path.read_bytes()) == pytest.approx(len(whole), rel=0.1)
    assert executable_cache._decompresses(path)


def test_other_warnings_and_other_folders_are_left_alone(tmp_path, monkeypatch):
    (tmp_path / "jit_a-1").write_bytes(b"damaged")
    message = "Error reading persistent compilation cache entry for 'jit_a': error"
    monkeypatch.setattr(executable_cache, "_own_folder", None)
    assert not executable_cache.discard_unreadable_entry(message)
    monkeypatch.setattr(executable_cache, "_own_folder", tmp_path)
    assert not executable_cache.discard_unreadable_entry("something else")
    assert os.listdir(tmp_path) == ["jit_a-1"]
    assert executable_cache.discard_unreadable_entry(message)
    assert os.listdir(tmp_path) == []


ASKED = """
import jax
import wholearm_jax as wa
wa.keep_compiled()
print(jax.config.values["jax_compilation_cache_dir"])
"""


@pytest.mark.parametrize(
    ("settings", "folder"),
    [
        ({"XDG_CACHE_HOME": "HERE"}, "HERE/wholearm_jax"),
        ({"XDG_CACHE_HOME": "", "HOME": "HERE"}, "HERE/.cache/wholearm_jax"),
        ({"XDG_CACHE_HOME": "HERE", "JAX_COMPILATION_CACHE_DIR": "HERE/other"}, "HERE/other"),
        ({"XDG_CACHE_HOME": "HERE", "JAX_ENABLE_COMPILATION_CACHE": "false"}, "None"),
    ],
)
def test_without_a_folder_it_is_the_command_lines_unless_jax_has_its_own(settings, folder, tmp_path):
    others = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}
    own = {name: value.replace("HERE", str(tmp_path)) for name, value in settings.items()}
    done = subprocess.run(
        [sys.executable, "-c", ASKED], capture_output=True, text=True, check=True, env=others | own, cwd=tmp_path
    )
    assert done.stdout.strip() == folder.replace("HERE", str(tmp_path))
