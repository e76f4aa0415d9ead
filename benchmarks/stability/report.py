"""The stability sweep's table, JSON and figure. On its own: the figure of the JSON that is kept, drawn anew."""

import json

import numpy as np

from benchmarks.measure import RESULTS, save
from benchmarks.stability.checks import DOUBLE, SINGLE, VIOLATIONS
from benchmarks.stability.levels import EXCESSES, REASONS, RESIDUALS, STATUSES
from benchmarks.stability.scenes import FAMILIES

QUANTILES = (0.5, 0.9, 0.99, 0.999, 1.0)
BLUE, ORANGE, GREY = "#0072b2", "#d55e00", "#999999"
BINS = np.arange(-18.0, 1.01, 0.5)  # of the residuals' exponents
NAMES = {
    "closure": "closure",
    "tangent": "tangent",
    "columns": "equations of motion, tables",
    "motion": "equations of motion",
    "constraint": "constraint",
    "energy": "energy",
}


def summary(found, limits) -> dict:
    """Counts and quantiles of one sweep."""
    traced = found["table_status"] == 0
    wrong = found["violations"]
    return {
        "scenes": len(wrong),
        "traced": int(traced.sum()),
        "moved": int(found["moved"].sum()),
        "status": named(found["status"], STATUSES),
        "status_by_family": {
            family: named(found["status"][found["family"] == k], STATUSES) for k, family in enumerate(FAMILIES)
        },
        "status_by_hand": {
            name: named(found["status"][found["layered"] == kind], STATUSES)
            for name, kind in (("layered", True), ("coplanar", False))
        },
        "ok_with_thickness_in_object": int(((found["status"] == 0) & (found["thickness"] > limits.overlap)).sum()),
        "reason_of_refusal": named(found["reason"][~traced], REASONS),
        "violations": {name: int((wrong >> bit & 1).sum()) for bit, name in enumerate(VIOLATIONS)},
        "scenes_with_violations": int((wrong != 0).sum()),
        "examples_of_violations": examples(found),
        "residual_quantiles": {
            name: dict(zip(map(str, QUANTILES), quantiles(found[name]), strict=True)) for name in RESIDUALS + EXCESSES
        },
        "residual_percent_by_exponent": {name: shares(found[name]) for name in NAMES},
        "condition_quantiles": quantiles(found["condition"][traced]),
        "levels": np.bincount(found["level"]).tolist(),
    }


def named(values, names):
    """How often each name occurs, those that do."""
    counts = np.bincount(values, minlength=len(names))
    return {name or "none": int(n) for name, n in zip(names, counts, strict=True) if n}


def quantiles(values):
    """The quantiles of what is finite."""
    values = values[np.isfinite(values)]
    return [float(f"{q:.3g}") for q in np.quantile(values, QUANTILES)] if len(values) else [None] * len(QUANTILES)


def shares(values):
    """How many percent of what is finite and positive lies in each of `BINS`, by exponent."""
    exponent = np.log10(np.maximum(values[np.isfinite(values) & (values > 0)], 10 ** BINS[0]))
    counts, _ = np.histogram(exponent, BINS)
    return np.round(100 * counts / max(len(exponent), 1), 4).tolist()


def examples(found, most=20):
    """The first scenes (block, row) of each kind of violation, to run them again."""
    some = {}
    for bit, name in enumerate(VIOLATIONS):
        rows = np.flatnonzero(found["violations"] >> bit & 1)[:most]
        if len(rows):
            some[name] = np.stack([found["block"][rows], found["row"][rows]], axis=1).tolist()
    return some


def compared(double, single) -> dict:
    """Single against double precision on the same scenes."""
    n = len(single["status"])
    same = {key: value[:n] for key, value in double.items()}
    both = same["moved"] & single["moved"] & (same["steps"] > 0) & (single["steps"] > 0)
    both &= np.isfinite(same["margin"]) & np.isfinite(single["margin"])
    close = both & (np.abs(same["length"] - single["length"]) < 1e-2 * same["length"])
    error = np.abs(single["margin"] - same["margin"])[close] / np.maximum(same["scale"][close], 1e-300)
    length = np.abs(single["length"] - same["length"])[both] / same["length"][both]
    return {
        "same_table_status": float(np.mean(same["table_status"] == single["table_status"])),
        "same_status": float(np.mean(same["status"] == single["status"])),
        "margin_error_of_largest_force": quantiles(error),
        "path_length_error": quantiles(length),
        "moved_in_both": int(both.sum()),
    }


def report(double, single, seed, seconds, *, keep):
    """Print the table, and write everything if it is to be kept."""
    result = {
        "seed": seed,
        "seconds": round(seconds),
        "float64": summary(double, DOUBLE),
        "float32": summary(single, SINGLE) | {"against_float64": compared(double, single)},
        "limits": {"float64": DOUBLE._asdict(), "float32": SINGLE._asdict()},
        "quantiles": QUANTILES,
    }
    dynamics(result)
    print(f"{seconds:.0f} s")
    if keep:
        save("stability", result)
        draw(result).savefig(RESULTS / "stability.svg")


def dynamics(result):
    """Print counts and residuals."""
    for precision in ("float64", "float32"):
        part = result[precision]
        print(f"\n{precision}: {part['scenes']} scenes, {part['traced']} traced, {part['moved']} moved")
        print("  " + ", ".join(f"{n} {name}" for name, n in part["status"].items()))
        for hand, counts in part["status_by_hand"].items():
            print(f"  {hand}: " + ", ".join(f"{n} {name}" for name, n in counts.items()))
        print(f"  ok, thickness in the object: {part['ok_with_thickness_in_object']}")
        print("  refused: " + ", ".join(f"{n} {name}" for name, n in part["reason_of_refusal"].items()))
        found = {name: n for name, n in part["violations"].items() if n}
        print("  violations: " + (", ".join(f"{n} {name}" for name, n in found.items()) or "none"))
        print("  " + f"{'residual':16}" + "".join(f"{q:>10}" for q in QUANTILES))
        for name in NAMES:
            print("  " + f"{name:16}" + "".join(f"{v:10.1e}" for v in part["residual_quantiles"][name].values()))


def draw(result):
    """Statuses as bars, residuals as histograms."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    plt.rcParams.update({"font.size": 8, "svg.fonttype": "none", "axes.spines.top": False, "axes.spines.right": False})
    figure = plt.figure(figsize=(9.0, 4.6), constrained_layout=True)
    left, right = figure.subfigures(1, 2, width_ratios=[1, 2.6])
    bars(left.subplots(), result["float64"]["status"])
    several = right.subplots(2, 3, sharex=True, sharey=True).ravel()
    for axes, (name, title) in zip(several, NAMES.items(), strict=True):
        percent = [result[p]["residual_percent_by_exponent"][name] for p in ("float64", "float32")]
        histogram(axes, *percent, result["limits"]["float64"][limit_of(name)], title)
    for axes in several[::3]:
        axes.set_ylabel("scenes / %")
    for axes in several[3:]:
        axes.set_xlabel("relative residual")
    right.legend(*several[0].get_legend_handles_labels(), frameon=False, loc="outside upper right", ncols=3)
    return figure


def limit_of(name):
    """Which limit a residual is held against."""
    return {"closure": "closure", "tangent": "tables", "columns": "tables", "energy": "energy"}.get(name, "motion")


def bars(axes, status):
    """How often each status occurs."""
    names = sorted(status, key=lambda name: status[name])
    counts = [status[name] for name in names]
    axes.barh(range(len(names)), counts, color=BLUE)
    for y, count in enumerate(counts):
        axes.text(count, y, f" {count:,}", va="center", fontsize=7)
    axes.set_yticks(range(len(names)), [name.replace("_", " ") for name in names])
    axes.set_xlim(0, max(counts) * 1.35)
    axes.set_xticks([])
    axes.spines["bottom"].set_visible(False)
    axes.set_title(f"status of {sum(counts):,} scenes (float64)", fontsize=8, loc="left")


def histogram(axes, double, single, limit, title):
    """One residual in both precisions, as shares of the scenes."""
    for percent, colour, label in ((double, BLUE, "float64"), (single, ORANGE, "float32")):
        axes.stairs(percent, BINS, fill=True, color=colour, alpha=0.75, label=label)
    axes.axvline(np.log10(limit), color=GREY, lw=0.8, ls="--", label="limit in float64")
    axes.set_xticks([-16, -8, 0], [f"$10^{{{k}}}$" for k in (-16, -8, 0)])
    axes.set_title(title, fontsize=8, loc="left")


if __name__ == "__main__":
    draw(json.loads((RESULTS / "stability.json").read_text())).savefig(RESULTS / "stability.svg")
