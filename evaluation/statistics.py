"""The figures of an experiment, method by method, from its records, and of two methods run by run."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import scipy  # whose `stats` is imported when it is asked for: it takes 0.4 s
from numpy.typing import NDArray

from evaluation.runs import Record
from specshield.sim.episodes import Episode

MODES = ("shaped", "switched", "completion", "prior", "fallback", "violated")  # of decisions
CONFIDENCE = 0.95
RESAMPLED = 2000  # samples of a bootstrap; chosen by hand
NOTHING = 1e-6  # [nats] or [steps]; a KL of less is what rounding leaves of 0
PERCENTILES = (("p50", 50.0), ("p99", 99.0), ("max", 100.0))
_TAILS = (0.5 - CONFIDENCE / 2, 0.5 + CONFIDENCE / 2)

Floats = NDArray[np.float64]


def clopper_pearson(k: int, n: int) -> tuple[float, float]:
    """The exact interval of a share of which k of n were seen, at CONFIDENCE (Clopper and Pearson, 1934)."""
    interval = scipy.stats.binomtest(k, n).proportion_ci(CONFIDENCE, method="exact")
    return float(interval.low), float(interval.high)


def mcnemar(pairs: Iterable[tuple[bool, bool]]) -> dict[str, Any]:
    """Whether two shares of the same runs differ: McNemar's test, exact and two-sided (McNemar, 1947).

    pairs: the two outcomes of each run. only, only_other: runs that the first alone, the second alone, has;
    p: how likely a split so uneven is, if each of them fell on either side with probability 1/2.
    """
    seen = list(pairs)
    only = sum(one and not other for one, other in seen)
    only_other = sum(other and not one for one, other in seen)
    split = only + only_other
    p = float(scipy.stats.binomtest(only, split, 0.5).pvalue) if split else 1.0
    return {"pairs": len(seen), "only": only, "only_other": only_other, "p": float(f"{p:.4g}")}


def mean_of(values: Sequence[float] | Floats) -> dict[str, Any]:
    """The mean of values [n], with the interval of a bootstrap over them; None where there are none."""
    found = np.asarray(values, np.float64)
    if len(found) == 0:
        return {"mean": None, "low": None, "high": None}
    low, high = np.quantile(_resampled(found[:, None])[:, 0], _TAILS)
    return {"mean": _rounded(found.mean()), "low": _rounded(low), "high": _rounded(high)}


def summary(method: str, records: Sequence[Record], unmodified: Sequence[Record]) -> dict[str, Any]:
    """The figures of one method, as JSON; means with the interval of a bootstrap over runs.

    unmodified: the records without any method. common: the runs that both have, and in how many of them each
    did the main task; extra_steps: how much later the model ended than unmodified, over the `both` of them in
    which both did. kl: mean over the runs of the sum along a run [nats]. broken: runs by the conjunct that
    was not kept. never_ended, ended_elsewhere: why the main task was not done. feasible_mass: mean over
    decisions. decision_ms: quantiles over all decisions of all runs.
    """
    plain = {record.run: record for record in unmodified}
    common = [(record, plain[record.run]) for record in records if record.run in plain]
    later = extra_steps(common)
    masses = [mass for record in records for mass in record.mass if mass is not None]
    times = np.concatenate([record.decision_ms for record in records])
    kl = mean_of([record.kl for record in records])
    return {
        "method": method,
        "runs": len(records),
        "satisfied": _share(record.satisfied for record in records),
        "main_done": _share(record.main_done for record in records),
        "never_ended": sum(record.ended_at is None for record in records),
        "ended_elsewhere": sum(record.ended_at is not None and not record.main_done for record in records),
        "broken": dict(Counter(part for record in records for part in record.broken)),
        "rho_median": _rounded(np.median([record.rho for record in records])),
        "kl": kl["mean"],
        "kl_interval": [kl["low"], kl["high"]],
        "common": {
            "runs": len(common),
            "main_done": sum(record.main_done for record, _ in common),
            "unmodified": sum(beside.main_done for _, beside in common),
        },
        "extra_steps": {
            "both": len(later),
            **mean_of(later),
            "median": _rounded(np.median(later)) if later else None,
        },
        "modes": _total(record.modes for record in records),
        "reasons": _total(record.reasons for record in records),
        "feasible_mass": _rounded(np.mean(masses)) if masses else None,
        "residual": _rounded(max(record.residual for record in records)),
        "decision_ms": {
            "decisions": len(times),
            **{name: _rounded(np.percentile(times, q)) for name, q in PERCENTILES},
        },
    }


def extra_steps(pairs: Iterable[tuple[Record, Record] | tuple[Episode, Episode]]) -> list[int]:
    """How much later the model ended in the first of each pair, of those in which both did the main task."""
    return [
        one.ended_at - other.ended_at
        for one, other in pairs
        if one.main_done and other.main_done and one.ended_at is not None and other.ended_at is not None
    ]


def beside(
    records: Sequence[Record], others: Sequence[Record], unmodified: Sequence[Record]
) -> dict[str, dict[str, Any]]:
    """One method beside another, over the runs that both have, as JSON.

    satisfied, main_done: `mcnemar`. kl, extra_steps: `costs_beside`.
    """
    theirs = {record.run: record for record in others}
    pairs = [(record, theirs[record.run]) for record in records if record.run in theirs]
    return {
        "satisfied": mcnemar((one.satisfied, other.satisfied) for one, other in pairs),
        "main_done": mcnemar((one.main_done, other.main_done) for one, other in pairs),
        **costs_beside(records, others, unmodified),
    }


def costs_beside(
    records: Sequence[Record], others: Sequence[Record], unmodified: Sequence[Record]
) -> dict[str, dict[str, Any]]:
    """Path KL [nats] and extra steps beside another method's, over the runs that both have.

    Extra steps are of the runs in which both methods and the unmodified model did the main task. See
    `compared` for what is said of each.
    """
    theirs = {record.run: record for record in others}
    plain = {record.run: record for record in unmodified}
    pairs = [(record, theirs[record.run]) for record in records if record.run in theirs]
    later = [
        (mine[0], other[0])
        for one, two in pairs
        if one.run in plain
        and (mine := extra_steps([(one, plain[one.run])]))
        and (other := extra_steps([(two, plain[two.run])]))
    ]
    return {"kl": compared([(one.kl, other.kl) for one, other in pairs]), "extra_steps": compared(later)}


def compared(pairs: Sequence[tuple[float, float]]) -> dict[str, Any]:
    """Two costs of the same runs, pair by pair; nothing is left out, however few they are.

    pairs: how many; mine, other: the means. difference, share: mine - other and mine / other, each with low
    and high, the interval of a bootstrap that draws whole pairs (Efron and Tibshirani, 1993). None: there
    are no pairs; of the share also: the other's mean is not above NOTHING, in the runs or in a bootstrap's
    sample.
    """
    if not pairs:
        nothing = ("mine", "other", "difference", "difference_low", "difference_high", "share", "low", "high")
        return {"pairs": 0, **dict.fromkeys(nothing)}
    both = np.array(pairs, np.float64)
    mine, other = both.mean(axis=0)
    means = _resampled(both)
    apart = np.quantile(means[:, 0] - means[:, 1], _TAILS)
    bounded = bool((means[:, 1] > NOTHING).all())
    low, high = np.quantile(means[:, 0] / means[:, 1], _TAILS) if bounded else (None, None)
    return {
        "pairs": len(both),
        "mine": _rounded(mine),
        "other": _rounded(other),
        "difference": _rounded(mine - other),
        "difference_low": _rounded(apart[0]),
        "difference_high": _rounded(apart[1]),
        "share": _rounded(mine / other) if other > NOTHING else None,
        "low": None if low is None else _rounded(low),
        "high": None if high is None else _rounded(high),
    }


def _resampled(rows: Floats) -> Floats:
    """The means of the columns of rows [n, k] in RESAMPLED samples of whole rows: [RESAMPLED, k]."""
    drawn = np.random.default_rng(0).integers(len(rows), size=(RESAMPLED, len(rows)))
    return np.asarray(rows[drawn].mean(axis=1))


def _share(outcomes: Iterable[bool]) -> dict[str, Any]:
    seen = list(outcomes)
    low, high = clopper_pearson(sum(seen), len(seen))
    return {"count": sum(seen), "of": len(seen), "low": _rounded(low), "high": _rounded(high)}


def _total(counts: Iterable[dict[str, int]]) -> dict[str, int]:
    return dict(sum((Counter(each) for each in counts), Counter[str]()))


def _rounded(value: Any) -> float:
    return round(float(value), 4)
