"""Summary of the results of very many scenes, of which only an evenly spaced sample is kept in memory."""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from wholearm_jax.core import Status
from wholearm_jax.ensembles.scene_check import BatchResult
from wholearm_jax.model import Scene

SAMPLE_SIZE = 100_000  # evenly spaced scenes from which quantiles and correlations are computed
QUANTILES = (0.0, 0.01, 0.05, 0.5, 0.95, 1.0)


@dataclass(frozen=True)
class EnsembleSummary:
    """How many of `count` scenes hold, how the others fail, and the margins of a sample."""

    count: int
    holds: int
    failures: dict[tuple[str, str, str | None], int]  # by names of phase, status and contact
    numbers: np.ndarray  # of the sampled scenes
    margins: np.ndarray  # [N], of the sampled scenes
    statuses: np.ndarray  # of the sampled scenes

    @property
    def interval(self) -> tuple[float, float]:
        """95 % confidence interval of the fraction that holds (Wilson's)."""
        return wilson_interval(self.holds, self.count)

    @property
    def quantiles(self) -> dict[str, float]:
        """Margins [N] by the fraction of the scenes below them; -inf where no motion could be scored."""
        ordered = np.sort(self.margins)
        return {f"{q:g}": float(ordered[round(q * (len(ordered) - 1))]) for q in QUANTILES}

    @property
    def lines(self) -> list[str]:
        """The summary as text."""
        low, high = (100 * end for end in self.interval)
        percent = 100 * self.holds / self.count
        lines = [
            f"{self.holds} of {self.count} hold: {percent:.2f} %, 95 % confidence interval {low:.2f} to {high:.2f} %",
            "margin [N] by quantile: " + ", ".join(f"{q}: {m:.4g}" for q, m in self.quantiles.items()),
        ]
        for (phase, status, contact), count in self._sorted_failures():
            lines.append(f"{phase}: {status}" + (f" at {contact}" if contact else "") + f": {count}")
        return lines

    def as_dict(self) -> dict:
        """Return the summary for a JSON file."""
        keys = ("phase", "status", "contact", "count")
        return {
            "count": self.count,
            "holds": self.holds,
            "share": self.holds / self.count,
            "interval": list(self.interval),
            "quantiles": {q: m if np.isfinite(m) else None for q, m in self.quantiles.items()},
            "failures": [dict(zip(keys, (*key, count), strict=True)) for key, count in self._sorted_failures()],
        }

    def _sorted_failures(self) -> list[tuple[tuple[str, str, str | None], int]]:
        """Failures with their counts, most frequent first."""
        return sorted(self.failures.items(), key=lambda item: -item[1])


def summarise(scene: Scene, chunks: Iterable[BatchResult], count: int) -> EnsembleSummary:
    """Summarise the results of `count` scenes, chunk by chunk; `scene` names phases and contacts."""
    stride, first, holds, failures = max(1, -(-count // SAMPLE_SIZE)), 0, 0, Counter()
    numbers, margins, statuses = [], [], []
    for part in chunks:
        failed = part.status != Status.OK
        holds += int((~failed).sum())
        kinds, counts = np.unique(
            np.stack([part.phase[failed], part.status[failed], part.contact[failed]]).astype(int),
            axis=1,
            return_counts=True,
        )
        for (row, status, contact), number in zip(kinds.T.tolist(), counts.tolist(), strict=True):
            phase = scene.phases[row]
            name = phase.formation.names[contact] if contact >= 0 else None
            failures[phase.name, Status(status).label, name] += number
        sampled = np.arange(-first % stride, len(part.status), stride)
        numbers.append(first + sampled)
        margins.append(part.margin[sampled])
        statuses.append(part.status[sampled])
        first += len(part.status)
    columns = (np.concatenate(column) for column in (numbers, margins, statuses))
    return EnsembleSummary(count, holds, dict(failures), *columns)


def wilson_interval(successes: int, trials: int) -> tuple[float, float]:
    """Wilson's 95 % confidence interval of a proportion."""
    from scipy.stats import binomtest  # takes half a second to import

    interval = binomtest(int(successes), int(trials)).proportion_ci(method="wilson")
    return float(interval.low), float(interval.high)


def rank_correlations(
    margins: Float[np.ndarray, "scenes"], offsets: Float[np.ndarray, "scenes parameters"]
) -> Float[np.ndarray, "parameters"]:
    """Compute Spearman's rank correlation of the margin with each parameter; 0 where either does not vary."""
    from scipy.stats import spearmanr

    correlations = np.zeros(offsets.shape[1])
    if len(margins) > 1 and np.any(margins != margins[0]):
        for k, column in enumerate(offsets.T):
            if np.ptp(column) > 0:
                correlations[k] = np.asarray(spearmanr(margins, column))[0]
    return correlations


def most_influential(
    parameters: Sequence[str], correlations: Float[np.ndarray, "parameters"], count: int = 2
) -> list[int]:
    """Return the numbers of the `count` parameters with the largest correlations; those without any are left out."""
    order = np.argsort(-np.abs(correlations), kind="stable")
    return [int(k) for k in order[:count] if correlations[k] != 0 and parameters[k]]
