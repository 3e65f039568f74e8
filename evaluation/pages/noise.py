"""The page of worlds that differ from what the shield was told."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from evaluation.calibration import kept_in
from evaluation.disturbance import DISTURBANCES
from evaluation.evaluation import read
from evaluation.pages.tables import Found, Results, beside_ours, better, kl, title
from evaluation.pages.words import NOISES, WHY_SLACK
from evaluation.results import markdown, share


def noise(found: Found) -> Iterator[str]:
    there = {results["experiment"]["noise"] for results in found.values()}
    yield "\n".join(f"- **{name}**: {NOISES[name]}." for name in DISTURBANCES if name in there)
    yield WHY_SLACK
    yield from better(found)
    for name in dict.fromkeys(map(title, found.values())):
        of = [results for results in found.values() if title(results) == name]
        of.sort(key=lambda results: DISTURBANCES.index(results["experiment"]["noise"]))
        yield f"## {name}"
        yield _table(of)
        yield "\n".join(
            f"{line[:2]}{results['experiment']['noise']}: {line[2:]}"
            for results in of
            for line in beside_ours(results)
        )
    lines = list(_calibrations(found))
    if lines:
        yield (
            "The margins with three digits are measured: `--methods NAME@conformal/8` first runs a "
            "calibration campaign of `ours` with another seed, and takes its margin for NAME, rounded up to "
            "millimetres (split conformal prediction, alpha 0.05, a run's largest surprise as its score). "
            "One campaign gives all methods of a world the same margin. How often it covered the surprises:"
        )
        yield "\n".join(lines)


def _table(experiments: Sequence[Results]) -> str:
    """A row a disturbance and method."""
    rows = [
        (
            results["experiment"]["noise"],
            one["method"],
            share(one["satisfied"]),
            share(one["main_done"]),
            kl(one),
            f"{one['modes'].get('fallback', 0) + one['modes'].get('violated', 0)} of "
            f"{sum(one['modes'].values())}",
            f"{one['residual']:.3f}",
        )
        for results in experiments
        for one in results["methods"]
    ]
    heads = (
        "world", "method", "rule kept", "main task done", "KL a run [nats]", "fallback or violated",
        "largest surprise [m]",
    )  # fmt: skip
    return markdown(heads, rows)


def _calibrations(found: Found) -> Iterator[str]:
    for kept, results in found.items():
        for made in kept_in(kept).values():
            at = f"@{made['rounded']:g}{made['asked']}"
            records = [record for record in read(kept) if record.method.endswith(at)]
            for method in dict.fromkeys(record.method for record in records):
                runs = [record for record in records if record.method == method]
                covered = sum(record.residual <= made["margin"] for record in runs)
                yield (
                    f"- {title(results)}, {results['experiment']['noise']}, {method}: "
                    f"{made['margin']:.4f} m from {made['runs']} other runs; it covered every step of "
                    f"{covered} of {len(runs)} runs."
                )
