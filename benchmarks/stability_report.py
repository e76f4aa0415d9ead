"""The stability sweep's table, JSON and figure."""

import numpy as np
from measure import RESULTS, save
from stability import STATUSES
from stability_checks import DOUBLE, SINGLE, VIOLATIONS
from stability_scenes import FAMILIES
from stability_sweep import EXCESSES, REASONS, RESIDUALS

QUANTILES = (0.5, 0.9, 0.99, 0.999, 1.0)
BLUE, ORANGE, GREY = "#0072b2", "#d55e00", "#999999"
NAMES = {
    "closure": "closure",
    "tangent": "tangent",
    "columns": "equations, table",
    "motion": "equations, motion",
    "constraint": "constraint",
    "energy": "energy",
}


def summary(found) -> dict:
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
        "reason_of_refusal": named(found["reason"][~traced], REASONS),
        "violations": {name: int((wrong >> bit & 1).sum()) for bit, name in enumerate(VIOLATIONS)},
        "scenes_with_violations": int((wrong != 0).sum()),
        "examples_of_violations": examples(found),
        "residual_quantiles": {
            name: dict(zip(map(str, QUANTILES), quantiles(found[name]), strict=True)) for name in RESIDUALS + EXCESSES
        },
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
        "wire_length_error": quantiles(length),
        "moved_in_both": int(both.sum()),
    }


def report(double, single, seed, seconds, *, keep):
    """Print the table, and write everything if it is to be kept."""
    result = {
        "seed": seed,
        "seconds": round(seconds),
        "float64": summary(double),
        "float32": summary(single) | {"against_float64": compared(double, single)},
        "limits": {"float64": DOUBLE._asdict(), "float32": SINGLE._asdict()},
        "quantiles": QUANTILES,
    }
    table(result)
    print(f"{seconds:.0f} s")
    if keep:
        save("stability", result)
        draw(double, single).savefig(RESULTS / "stability.svg")


def table(result):
    """Print counts and residuals."""
    for precision in ("float64", "float32"):
        part = result[precision]
        print(f"\n{precision}: {part['scenes']} scenes, {part['traced']} traced, {part['moved']} moved")
        print("  " + ", ".join(f"{n} {name}" for name, n in part["status"].items()))
        print("  refused: " + ", ".join(f"{n} {name}" for name, n in part["reason_of_refusal"].items()))
        found = {name: n for name, n in part["violations"].items() if n}
        print("  violations: " + (", ".join(f"{n} {name}" for name, n in found.items()) or "none"))
        print("  " + f"{'residual':16}" + "".join(f"{q:>10}" for q in QUANTILES))
        for name in NAMES:
            print("  " + f"{name:16}" + "".join(f"{v:10.1e}" for v in part["residual_quantiles"][name].values()))


def draw(double, single):
    """Statuses as bars, residuals as histograms."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    plt.rcParams.update({"font.size": 8, "svg.fonttype": "none", "axes.spines.top": False, "axes.spines.right": False})
    figure = plt.figure(figsize=(7.2, 4.6), constrained_layout=True)
    grid = figure.add_gridspec(2, 4)
    bars(figure.add_subplot(grid[:, 0]), double)
    for k, (name, title) in enumerate(NAMES.items()):
        axes = figure.add_subplot(grid[k // 3, 1 + k % 3])
        histogram(axes, double[name], single[name], getattr(DOUBLE, limit_of(name)), title)
        if k == 0:
            axes.legend(frameon=False, loc="upper center", fontsize=7)
    return figure


def limit_of(name):
    """Which limit a residual is held against."""
    return {"closure": "closure", "tangent": "tables", "columns": "tables", "energy": "energy"}.get(name, "motion")


def bars(axes, found):
    """How often each status occurs."""
    counts = np.bincount(found["status"], minlength=len(STATUSES))
    order = np.argsort(counts)
    order = order[counts[order] > 0]
    axes.barh(range(len(order)), counts[order], color=BLUE)
    for y, k in enumerate(order):
        axes.text(counts[k], y, f" {counts[k]:,}", va="center", fontsize=7)
    axes.set_yticks(range(len(order)), [STATUSES[k].replace("_", " ") for k in order])
    axes.set_xlim(0, counts.max() * 1.35)
    axes.set_xticks([])
    axes.spines["bottom"].set_visible(False)
    axes.set_title(f"status of {counts.sum():,} scenes", fontsize=8, loc="left")


def histogram(axes, double, single, limit, title):
    """One residual in both precisions, as shares of the scenes."""
    bins = np.arange(-18.0, 1.01, 0.5)
    for values, colour, label in ((double, BLUE, "float64"), (single, ORANGE, "float32")):
        exponent = np.log10(np.maximum(values[np.isfinite(values) & (values > 0)], 1e-18))
        if len(exponent):
            weights = np.full(len(exponent), 100 / len(exponent))
            axes.hist(exponent, bins, weights=weights, color=colour, alpha=0.75, label=label)
    axes.axvline(np.log10(limit), color=GREY, lw=0.8, ls="--")
    axes.set_xticks([-16, -12, -8, -4, 0], [f"$10^{{{k}}}$" for k in (-16, -12, -8, -4, 0)])
    axes.set_xlabel(f"{title}, relative")
    axes.set_ylabel("scenes / %")
