"""The package is read top to bottom: each module imports only from those above it; shapes decide what compiles."""

import ast
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import wholearm_jax as wa
from wholearm_jax.model.scene import polygon
from wholearm_jax.phases.phase_simulation import _simulate_phase
from wholearm_jax.phases.phase_tracing import trace_phase

PACKAGE = Path(wa.__file__).parent
ORDER = (
    *(
        "status",
        "settings",
        "precision",
        "requirements",
        "lookup",
        "outline",
        "scene",
        "contacts",
        "system",
        "elimination",
        "newton",
        "writing",
        "programs",
    ),
    *("watch", "march", "start", "places", "wire", "reduction"),
    *("schedule", "stepping", "landing", "motion", "forces", "verdict", "holding"),
    *("phase", "result", "resting", "sampling", "plan", "gradient", "gradient_check"),
    *("squeeze", "shooting", "linearisation", "recursion", "descent", "pacing"),
    *("formations", "guesses", "handover", "group", "optimiser", "baseline"),
    *("variation", "batch", "robust", "proportion", "survey"),
    *("free_bodies", "coulomb", "execution", "perturbation"),
    *("scene_file", "result_file", "store", "polygon_file", "palette", "report"),
    *("drawing", "execution_drawing", "survey_drawing", "__init__"),
    *("arguments", "finishing", "batch_command", "robust_command", "execution_command", "command"),
)


def imports(path):
    """Names of the package's own modules that a file imports anywhere in it."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("wholearm_jax"):
            yield node.module.partition(".")[2] or "__init__"


def test_each_module_imports_only_from_those_above_it():
    assert {p.stem for p in PACKAGE.glob("*.py")} == set(ORDER)
    for place, name in enumerate(ORDER):
        below = set(imports(PACKAGE / f"{name}.py")) - set(ORDER[:place])
        assert not below, f"{name} imports {below} from below"


def test_matplotlib_stays_in_the_drawing_modules_and_the_command_line():
    for path in PACKAGE.glob("*.py"):
        if path.stem not in (
            "drawing",
            "execution_drawing",
            "survey_drawing",
            "batch_command",
            "execution_command",
            "command",
        ):
            assert "matplotlib" not in path.read_text(), path.stem


def test_mujoco_stays_in_the_modules_that_execute():
    executing = {"free_bodies", "coulomb", "execution", "perturbation"}
    for path in PACKAGE.glob("*.py"):
        tree = ast.parse(path.read_text())
        top = {name for node in tree.body if isinstance(node, ast.ImportFrom) for name in [(node.module or "")]}
        assert not any(name.rpartition(".")[2] in executing for name in top) or path.stem in executing, path.stem
        assert "import mujoco" not in path.read_text() or path.stem in executing, path.stem


def test_the_public_interface_is_small():
    assert len(wa.__all__) <= 20
    assert all(hasattr(wa, name) for name in wa.__all__)


def test_scenes_of_one_size_share_their_programs():
    """Sliding and rolling contacts, five formations in all: trace, reduce and simulate compile once each."""
    compiled = {}

    def count(name, *_, **__):
        compiled[name] = compiled.get(name, 0) + 1

    for name in ("heptagon", "hexagon", "tipping"):
        scene = wa.load(name)
        with jax.log_compiles(False):
            wa.simulate(scene, wa.quasistatic(scene))
        sizes = trace_phase.sizes(), _simulate_phase.sizes()
        count(sizes)
    assert len(compiled) == 1, f"a later scene compiled again: {compiled}"


def test_reading_scenes_and_schedules_compiles_nothing():
    """`jnp.asarray` of what is no array yet compiles a program for every shape, in every process anew."""
    compiled = []

    def listen(event, _, **__):
        compiled.append(event)

    angle = np.linspace(0.0, 2 * np.pi, 37, endpoint=False)  # sizes that no other test has
    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        polygon(np.stack([np.cos(angle), np.sin(angle)], axis=1), 1.0, 0.1)
        wa.torque_schedule(np.linspace(0.0, 1.0, 37), np.zeros((37, 2)))
        assert "/jax/core/compile/backend_compile_duration" not in compiled
        jnp.arange(37.0) + 1
        assert "/jax/core/compile/backend_compile_duration" in compiled  # the listener hears what is compiled
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
