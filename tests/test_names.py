"""One word for one thing: no file or function too long to read, no name with two meanings, none of the former slang."""

import ast
import statistics
from collections import defaultdict
from pathlib import Path

import wholearm_jax as wa

PACKAGE = Path(wa.__file__).parent
TREES = {path: ast.parse(path.read_text()) for path in sorted(PACKAGE.rglob("*.py"))}
LONGEST_FUNCTION, LONGEST_FILE, MEDIAN_FILE = 60, 400, 160  # lines
FORMER_WORDS = """
    wire Wire Pieces breaks told_by end_why NO_END march March _Way _predicted speeds_of signs_of flips Watch Watched
    watch_of watch crossings Places places_of _vanishing branched _branches project _pierced oriented leading rough
    Along along_wire Heading several Frame Contacts slip_rows constraint_rows gap_rates along_rates constraint_rates
    every_contact every_meeting _swing _turned watched pick put digits first_flaw stays_simple pair_name
    reduce_wire tension grip Change on_panel combined Window window evenly in_turn rounded has_steps Integration how
    reversible Stop reused jumped with_room roomy land astray LANDINGS held_at entry_w _wait Score Arcs arcs on_arc
    linear_slacks _dips _dip _carried temperature Hold Bound tops Held Support steadiest JAMMED POSSIBLE NEVER
    surely_held _proved Verdict judge BRAKING PULL Traced prepare Outcome run_blank simulate_told hardest BRIEF Way
    shoot Shot pace _paces PACES _uncut _one_part _set_out Rooms rooms room bears pinned _seams passed_on gather
    scattered change_of_rooms Quadratic _Order _Stages _back _forth _prices Duals HOTTEST COLDEST _reach Descent joining
    JOINED WARMER WARMEST descend _alike OTHERS PROFILES Handover handover handovers Near steady BRISK FAST SURE Wanted
    optimise_group _honest Optimised LEADS _raise shifts shifted Checked Given Level QUICK FULL GOOD FINER ALONE Survey
    survey influences _climb _missed wilson FreeBodies free_bodies Softness DOT Ending Course drive Perturbed
    Program keep uncollected _uncollected write_whole Written _drawn finish descending counting told seen_of
    told wanted_of evenly beside_of _apart Torque
""".split()  # noqa: SIM905
"""Identifiers of earlier versions, each with a standard term in its place (`docs/glossary.md`)."""
SAME_THING = {
    "check": "the command and the function that it calls",
    "execute": "the command and the function that it calls",
    "optimise": "the command and the function that it calls",
    "plan": "the command and the function that it calls",
    "report": "the command and the function that it calls",
    "simulate": "the command and the function that it calls",
    "tradeoff": "the command and the function that it calls",
}
"""Public names that two modules define, and why."""


def top_level():
    """Names that modules define at their top level -> the modules; those of one module alone start with `_`."""
    names = defaultdict(set)
    for path, tree in TREES.items():
        if path.name.startswith("__"):
            continue
        for node in tree.body:
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                defined = [node.name]
            elif isinstance(node, ast.Assign | ast.AnnAssign):
                targets = node.targets if isinstance(node, ast.Assign) else [node.target]
                defined = [n.id for target in targets for n in ast.walk(target) if isinstance(n, ast.Name)]
            else:
                continue
            for name in defined:
                names[name].add(str(path.relative_to(PACKAGE)))
    return names


def identifiers():
    """Every name that the package's code defines or uses -> the files in which it stands."""
    found = defaultdict(set)
    for path, tree in TREES.items():
        found[path.stem].add(path.name)
        for node in ast.walk(tree):
            for field in ("name", "arg", "id", "attr"):
                if isinstance(name := getattr(node, field, None), str):
                    found[name].add(path.name)
    return found


def test_no_public_name_stands_for_two_things():
    names = top_level()
    assert len(names) > 800
    twice = {name: sorted(places) for name, places in names.items() if len(places) > 1 and not name.startswith("_")}
    assert twice.keys() == SAME_THING.keys(), twice


def test_constants_are_defined_once():
    twice = {n: sorted(p) for n, p in top_level().items() if n.strip("_").isupper() and len(p) > 1}
    assert not twice


def test_former_words_are_gone():
    found = identifiers()
    assert len(found) > 3000
    assert not {word: sorted(found[word]) for word in FORMER_WORDS if word in found}
    assert not {name for name in found if {"wire", "wires"} & set(name.lower().split("_"))}


def test_functions_and_files_can_be_read():
    lengths = {str(path.relative_to(PACKAGE)): len(path.read_text().splitlines()) for path in TREES}
    assert not {name: n for name, n in lengths.items() if n > LONGEST_FILE}
    assert statistics.median(lengths.values()) <= MEDIAN_FILE
    long, count = {}, 0
    for path, tree in TREES.items():
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef):
                count += 1
                body = node.body[1:] if ast.get_docstring(node) else node.body
                lines = node.end_lineno - body[0].lineno + 1 if body else 0
                if lines > LONGEST_FUNCTION:
                    long[f"{path.relative_to(PACKAGE)}: {node.name}"] = lines
    assert count > 900
    assert not long
