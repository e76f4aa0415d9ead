"""The package is read top to bottom: who imports whom, what loads when; shapes decide what compiles."""

import ast
import contextlib
import re
import subprocess
import sys
from collections import defaultdict
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import wholearm_jax as wa
from wholearm_jax.ensembles import SceneBatch
from wholearm_jax.ensembles.scene_batch import stack_scenes
from wholearm_jax.execution import Amounts
from wholearm_jax.execution.trials import _draw_scenes
from wholearm_jax.model import link_overlaps, polygon
from wholearm_jax.phases.phase_ends import ends_at_stop
from wholearm_jax.phases.phase_simulation import _simulate_phase
from wholearm_jax.phases.phase_tracing import trace_phase

PACKAGE = Path(wa.__file__).parent
CORE = ("core",)
GEOMETRY = (*CORE, "model")
PATHS = (*GEOMETRY, "tracing")
MOTIONS = (*PATHS, "dynamics", "simulation")
PLANS = (*MOTIONS, "margin", "phases")
MANY = (*PLANS, "optimisation", "planning", "feedback", "ensembles")
ABOVE = {
    "core": (),
    "model": CORE,
    "tracing": GEOMETRY,
    "dynamics": PATHS,
    "simulation": (*PATHS, "dynamics"),
    "margin": MOTIONS,
    "phases": (*MOTIONS, "margin"),
    "optimisation": PLANS,
    "planning": PLANS,
    "feedback": PLANS,
    "ensembles": MANY,
    "execution": (*GEOMETRY, "phases", "feedback", "ensembles"),
    "files": (*GEOMETRY, "phases", "planning", "feedback", "ensembles"),
    "plotting": (*GEOMETRY, "phases", "planning", "feedback", "ensembles", "files"),
    "report": (*GEOMETRY, "files", "plotting"),
    "cli": (*MANY, "execution", "files", "plotting", "report"),
}
"""Which folders each folder may import from (`docs/architecture.md`)."""
FOR_TYPES = {"files": ("execution",), "plotting": ("execution", "optimisation")}
"""Which more for annotations alone, under `TYPE_CHECKING`."""
HEAVY = ("matplotlib", "mujoco", "zarr", "joblib", "jinja2", "rich", "ezdxf", "svgelements", "trimesh", "scipy")


def sources(package=PACKAGE):
    """Every file of the package with its tree."""
    return {path: ast.parse(path.read_text()) for path in sorted(package.rglob("*.py"))}


def imported(path, tree, package=PACKAGE):
    """`(module, names, for types alone)` of all imports of the package's own modules, absolute or relative."""
    guarded = {
        id(inner)
        for node in ast.walk(tree)
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)
        for inner in ast.walk(node)
    }
    here = ("wholearm_jax", *path.relative_to(package).parent.parts)
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found = [(alias.name, ()) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = ".".join(here[: len(here) - node.level + 1]) if node.level else ""
            found = [(".".join(filter(None, (base, node.module))), tuple(alias.name for alias in node.names))]
        else:
            continue
        for module, names in found:
            if module.partition(".")[0] == "wholearm_jax":
                yield module, names, id(node) in guarded


def upward(package=PACKAGE):
    """Imports from folders that a file's own folder may not know, and how many imports were looked at."""
    wrong, count = [], 0
    for path, tree in sources(package).items():
        folder = path.relative_to(package).parts[0]
        if folder.endswith(".py"):
            continue  # the root and `__main__` know all
        for module, names, for_types in imported(path, tree, package):
            others = [module.split(".")[1]] if "." in module else list(names)
            count += len(others)
            known = {folder, *ABOVE[folder], *(FOR_TYPES.get(folder, ()) if for_types else ())}
            wrong += [f"{path.relative_to(package)} imports {other}" for other in others if other not in known]
    return wrong, count


def test_folders_import_only_from_those_above_them():
    folders = {path.name for path in PACKAGE.iterdir() if path.is_dir() and path.name not in ("__pycache__", "scenes")}
    assert folders <= set(ABOVE)
    assert len(sources()) > 90, "every file is looked at"
    wrong, count = upward()
    assert count > 350
    assert not wrong, wrong


@pytest.mark.parametrize(
    "line", ["from wholearm_jax.cli import app", "import wholearm_jax.plotting", "from ..margin import force_slack"]
)
def test_an_upward_import_is_seen(tmp_path, line):
    core = tmp_path / "core"
    core.mkdir()
    (core / "arrays.py").write_text("import jax\n")
    assert upward(tmp_path)[0] == []
    (core / "arrays.py").write_text(f"def late():\n    {line}\n")
    assert len(upward(tmp_path)[0]) == 1


def test_modules_of_a_folder_do_not_import_one_another_in_circles():
    followed = 0
    for folder in ABOVE:
        edges = defaultdict(set)
        for path, tree in sources().items():
            if path.parent != PACKAGE / folder or path.stem == "__init__":
                continue
            for module, names, for_types in imported(path, tree):
                parts = module.split(".")
                if len(parts) > 1 and parts[1] == folder and not for_types:
                    assert len(parts) > 2 or all((path.parent / f"{n}.py").exists() for n in names), (
                        f"{path.name} imports through its own folder"
                    )
                    edges[path.stem] |= {parts[2]} if len(parts) > 2 else set(names)
        followed += sum(map(len, edges.values()))
        left = {name: set(others) for name, others in edges.items()}
        while left:
            free = [name for name, others in left.items() if not others & set(left)]
            assert free, f"{folder}: a circle among {sorted(left)}"
            left = {name: others for name, others in left.items() if name not in free}
    assert followed > 60


def test_nothing_stands_beside_the_folders():
    assert {p.name for p in PACKAGE.glob("*.py")} == {"__init__.py", "__main__.py"}


def test_heavy_libraries_stay_where_they_belong():
    allowed = {
        "matplotlib": ("plotting", "cli"),
        "mujoco": ("execution", "cli"),
        "zarr": ("files/check_store.py", "cli/check.py"),
        "jinja2": ("report",),
        "joblib": ("execution", "cli"),
        "rich": ("cli",),
        "ezdxf": ("files/dxf_curves.py",),
        "svgelements": ("files/svg_curves.py",),
        "trimesh": ("files/stl_section.py",),
    }
    seen = set()
    for path, tree in sources().items():
        for node in ast.walk(tree):
            modules = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            modules += [node.module or ""] if isinstance(node, ast.ImportFrom) and not node.level else []
            for library in {module.partition(".")[0] for module in modules} & set(allowed):
                seen.add(library)
                place = str(path.relative_to(PACKAGE))
                assert place.startswith(allowed[library]), f"{place} imports {library}"
    assert seen == set(allowed)


def test_importing_the_package_loads_no_heavy_library():
    told = subprocess.run(
        [sys.executable, "-c", f"import sys, wholearm_jax; print([m for m in {HEAVY} if m in sys.modules])"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert told.stdout.strip() == "[]"


def test_the_public_interface_exists():
    assert len(wa.__all__) == len(set(wa.__all__)) >= 20
    assert all(hasattr(wa, name) for name in wa.__all__)


def test_scenes_of_one_size_share_their_programs():
    """Sliding and rolling contacts, five formations in all: trace, reduce and simulate compile once each."""
    compiled = set()
    for name in ("heptagon", "hexagon", "tipping"):
        scene = wa.load(name)
        with jax.log_compiles(False):
            wa.simulate(scene, wa.quasistatic(scene))
        compiled.add((trace_phase.compiled_count(), _simulate_phase.compiled_count()))
    assert len(compiled) == 1, f"a later scene compiled again: {compiled}"


@contextlib.contextmanager
def compilations():
    """Collect an entry for each program that is compiled meanwhile."""
    compiled = []

    def listen(event, _, **__):
        if event == "/jax/core/compile/backend_compile_duration":
            compiled.append(event)

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        yield compiled
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)


def test_reading_scenes_and_schedules_compiles_nothing():
    """`jnp.asarray` of what is no array yet compiles a program for every shape, in every process anew."""
    angle = np.linspace(0.0, 2 * np.pi, 37, endpoint=False)  # sizes that no other test has
    with compilations() as compiled:
        polygon(np.stack([np.cos(angle), np.sin(angle)], axis=1), 1.0, 0.1)
        wa.torque_schedule(np.linspace(0.0, 1.0, 37), np.zeros((37, 2)))
        assert not compiled
        jnp.arange(37.0) + 1
    assert compiled  # the listener hears what is compiled


def test_stacking_scenes_and_choosing_from_them_compiles_nothing():
    """`jnp.stack` compiles a program for every count: half a minute for two thousand scenes."""
    with compilations() as compiled:
        many = stack_scenes([wa.load("heptagon")] * 37)
        SceneBatch(many).select(np.arange(31))
    assert not compiled


def test_what_is_asked_of_a_plan_on_the_host_is_few_programs():
    """Geometry that is not traced as a whole compiles an operation at a time: hundreds, in every process anew."""
    scene = wa.load("heptagon")
    traced = wa.trace(scene)
    with compilations() as compiled:
        assert ends_at_stop(scene, scene.phases[0], traced[0])
        link_overlaps(scene.hand, scene.start[3:])
        _draw_scenes(scene, Amounts(friction=0.1), seed=0, count=3)
    assert len(compiled) <= 12


def test_docstrings_name_modules_that_exist():
    """A doctest's exception paths and the script's entry are of today's layout."""
    modules = {".".join(("wholearm_jax", *p.relative_to(PACKAGE).with_suffix("").parts)) for p in sources()}
    modules |= {module.rpartition(".")[0] for module in modules} | {"wholearm_jax"}
    named = 0
    for path in sources():
        for module in re.findall(r"\bwholearm_jax(?:\.[a-z_]+)+", path.read_text()):
            named += 1
            parts = module.split(".")
            assert any(".".join(parts[:n]) in modules for n in (len(parts), len(parts) - 1)), f"{path.name}: {module}"
    assert named > 100
