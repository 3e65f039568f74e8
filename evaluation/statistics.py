"""The figures of an experiment, method by method, from its records."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binomtest

from evaluation.runs import Record
from specshield.sim.episodes import Episode

MODES = ("shaped", "switched", "completion", "prior", "fallback", "violated")  # of decisions
CONFIDENCE = 0.95
RESAMPLED = 2000  # samples of a bootstrap; chosen by hand
FEW = 20  # runs; with fewer, extra steps are not compared (chosen by hand)


def clopper_pearson(k: int, n: int) -> tuple[float, float]:
    """The exact interval of a share of which k of n were seen, at CONFIDENCE (Clopper and Pearson, 1934)."""
    interval = binomtest(k, n).proportion_ci(CONFIDENCE, method="exact")
    return float(interval.low), float(interval.high)


def summary(method: str, records: Sequence[Record], unmodified: Sequence[Record]) -> dict[str, Any]:
    """The figures of one method, as JSON.

    unmodified: the records without any method. common: the runs that both have, and in how many of them each
    did the main task; extra_steps: how much later the model ended than unmodified, over the `both` of them in
    which both did. kl: mean over the runs of the sum along a run [nats]. broken: runs by the conjunct that
    was not kept. never_ended, ended_elsewhere: why the main task was not done. feasible_mass: mean over
    decisions.
    """
    plain = {record.run: record for record in unmodified}
    common = [(record, plain[record.run]) for record in records if record.run in plain]
    later = extra_steps(common)
    masses = [mass for record in records for mass in record.mass if mass is not None]
    return {
        "method": method,
        "runs": len(records),
        "satisfied": _share(record.satisfied for record in records),
        "main_done": _share(record.main_done for record in records),
        "never_ended": sum(record.ended_at is None for record in records),
        "ended_elsewhere": sum(record.ended_at is not None and not record.main_done for record in records),
        "broken": dict(Counter(part for record in records for part in record.broken)),
        "rho_median": _rounded(np.median([record.rho for record in records])),
        "kl": _rounded(np.mean([record.kl for record in records])),
        "common": {
            "runs": len(common),
            "main_done": sum(record.main_done for record, _ in common),
            "unmodified": sum(beside.main_done for _, beside in common),
        },
        "extra_steps": {
            "both": len(later),
            "mean": _rounded(np.mean(later)) if later else None,
            "median": _rounded(np.median(later)) if later else None,
        },
        "modes": _total(record.modes for record in records),
        "reasons": _total(record.reasons for record in records),
        "feasible_mass": _rounded(np.mean(masses)) if masses else None,
        "residual": _rounded(max(record.residual for record in records)),
        "decision_ms": {
            name: _rounded(np.median([record.decision_ms[name] for record in records]))
            for name in ("p50", "p99")
        },
    }


def extra_steps(pairs: Iterable[tuple[Record, Record] | tuple[Episode, Episode]]) -> list[int]:
    """How much later the model ended in the first of each pair, of those in which both did the main task."""
    return [
        one.ended_at - other.ended_at
        for one, other in pairs
        if one.main_done and other.main_done and one.ended_at is not None and other.ended_at is not None
    ]


def costs_beside(
    records: Sequence[Record], others: Sequence[Record], unmodified: Sequence[Record]
) -> dict[str, dict[str, float] | None]:
    """Path KL and mean extra steps as shares of another method's, over the runs that both have.

    share, low, high: with the interval of a bootstrap over those runs (Efron and Tibshirani, 1993). None
    where the other method costs less than 1 nat or step, and for extra steps of fewer than FEW runs.
    """
    theirs = {record.run: record for record in others}
    plain = {record.run: record for record in unmodified}
    pairs = [(record, theirs[record.run]) for record in records if record.run in theirs]
    later = [
        [extra_steps([(one, plain[one.run])]) if one.run in plain else [] for one in pair] for pair in pairs
    ]
    steps = np.array([[each[0] if each else np.nan for each in pair] for pair in later], dtype=np.float64)
    kl = np.array([[mine.kl, other.kl] for mine, other in pairs])
    enough = len(pairs) > 0 and int(np.isfinite(steps).sum(axis=0).min()) >= FEW
    return {"kl": _ratio(kl), "extra_steps": _ratio(steps) if enough else None}


def _ratio(pairs: NDArray[np.float64]) -> dict[str, float] | None:
    """The ratio of two columns' means, pairs [n, 2]; NaN: not counted."""
    if len(pairs) == 0 or not np.nanmean(pairs[:, 1]) > 1.0:
        return None
    drawn = np.random.default_rng(0).integers(len(pairs), size=(RESAMPLED, len(pairs)))
    means = np.nanmean(pairs[drawn], axis=1)
    low, high = np.quantile(means[:, 0] / means[:, 1], [0.5 - CONFIDENCE / 2, 0.5 + CONFIDENCE / 2])
    share = np.nanmean(pairs[:, 0]) / np.nanmean(pairs[:, 1])
    return {"share": _rounded(share), "low": _rounded(low), "high": _rounded(high)}


def _share(outcomes: Iterable[bool]) -> dict[str, Any]:
    seen = list(outcomes)
    low, high = clopper_pearson(sum(seen), len(seen))
    return {"count": sum(seen), "of": len(seen), "low": _rounded(low), "high": _rounded(high)}


def _total(counts: Iterable[dict[str, int]]) -> dict[str, int]:
    return dict(sum((Counter(each) for each in counts), Counter[str]()))


def _rounded(value: Any) -> float:
    return round(float(value), 4)
