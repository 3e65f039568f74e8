"""docs/results.md, on three screens: a table for each case, its caveats, and links to the other pages."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from evaluation.pages.tables import Found, Results, better_in_short, title
from evaluation.pages.words import CAVEATS, HOW, SHORT, UNDER_NOISE, WITH_200
from evaluation.results import markdown, share
from evaluation.statistics import clopper_pearson

FRONT = ("unmodified", "rcd+", "simplex", "rule-first", "paper", "ours", "ours@0/25", "lookahead")
NOISY = ("ours", "paper", "rule-first", "ours@default", "paper@default")


def summary(found: Found, elsewhere: Mapping[str, str], noisy: Found, harder: Found) -> Iterator[str]:
    """found: the main experiments. elsewhere: other pages, {title: path}. noisy, harder: those of the pages
    of noise and of harder tasks.
    """
    gaussian = [each for each in noisy.values() if each["experiment"]["noise"] == "gaussian"]
    shown = list(found.values()) or gaussian
    yield "# Results"
    if shown:
        seeds = sorted({each["experiment"]["seed"] for each in shown})
        runs = sorted({each["runs"] for each in shown})
        yield HOW.format(seeds=", ".join(map(str, seeds)), runs=" or ".join(map(str, runs)))
    yield SHORT
    for case in dict.fromkeys(results["case"] for results in found.values()):
        yield from _case([results for results in found.values() if results["case"] == case])
    yield CAVEATS + _with_200(harder, elsewhere) + _under_noise(gaussian)
    yield _noise(gaussian)
    yield from better_in_short(found)
    yield "## More"
    yield "; ".join(f"[{name}]({path})" for name, path in elsewhere.items()) + "."
    yield (
        "`make results` makes these pages again, but for the rows of 16,000 updates on the page of the "
        "rewards, the ProcTHOR houses (left out unless `HOUSES=FOLDER` has them), the choice of RCD's "
        "constants, and the texts on look-ahead and the neighbours, which are written by hand."
    )


def _case(models: Sequence[Results]) -> Iterator[str]:
    """A row a method of FRONT, with both models side by side. models: the experiments of one case."""
    one = models[0]
    yield f'**{one["case"]}**: `{one["formula"]}`; the model is told "{one["instruction"]}".'
    names = [results["experiment"]["model"] for results in models]
    heads = [f"{what}, {name}" for what in ("rule", "task", "KL", "extra steps") for name in names]
    by_method = [{one["method"]: one for one in results["methods"]} for results in models]
    rows = []
    for method in FRONT:
        of = [methods.get(method) for methods in by_method]
        if any(of):
            figures = [[_NOT_RUN] * 4 if one is None else _figures(one) for one in of]
            rows.append((method, *(figure for what in zip(*figures, strict=True) for figure in what)))
    yield markdown(("method", *heads), rows)


_NOT_RUN = "not run"


def _figures(one: Mapping[str, Any]) -> list[str]:
    """Rule kept, main task done, KL and extra steps of a method, in short, each with its interval."""
    later, (low, high) = one["extra_steps"], one["kl_interval"]
    costs = [f"{one['kl']:.0f} ({low:.0f}–{high:.0f})", "no run"]
    if one["method"] == "unmodified":  # what the others are compared with
        costs = ["0", "0"]
    elif later["mean"] is not None:
        costs[1] = f"{later['mean']:+.0f} ({later['low']:+.0f} to {later['high']:+.0f})"
    return [_brief(one["satisfied"]), _brief(one["main_done"]), *costs]


def _brief(of: Mapping[str, Any]) -> str:
    return f"{of['count']} ({100 * of['low']:.0f}–{100 * of['high']:.0f} %)"


def _with_200(harder: Found, elsewhere: Mapping[str, str]) -> str:
    """What the limit of 600 steps hides, if the cases were run with one of 200 by all that are compared."""
    cells = [each for each in harder.values() if re.fullmatch("[^-]+-200", each["case"])]
    done = {}
    for method in ("unmodified", "ours", "lookahead"):
        of = [one["main_done"] for each in cells for one in each["methods"] if one["method"] == method]
        count, runs = (sum(one[name] for one in of) for name in ("count", "of"))
        if len(of) < max(len(cells), 1):
            return ""
        low, high = clopper_pearson(count, runs)
        done[method] = share({"count": count, "of": runs, "low": low, "high": high})
    several = len(cells) > 1
    over = f"{len(cells)} pairs of case and model" if several else "one case and model"
    shared = "; the pairs share starts, so these intervals are\n  too narrow" if several else ""
    return WITH_200.format(cells=over, shared=shared, page=elsewhere["Harder main tasks"], **done)


def _under_noise(gaussian: Sequence[Results]) -> str:
    of = [one["satisfied"] for each in gaussian for one in each["methods"] if one["method"] == "ours"]
    lost = " and ".join(f"{each['of'] - each['count']} of {each['of']}" for each in of)
    return f"\n{UNDER_NOISE.format(lost=lost)}" if of else ""


def _noise(noisy: Sequence[Results]) -> str:
    """How many runs keep the rule under gaussian noise, a row a case."""
    if not noisy:
        return ""
    heads = ("gaussian noise, rule kept", *NOISY)
    rows = []
    for results in noisy:
        kept = {one["method"]: share(one["satisfied"]) for one in results["methods"]}
        rows.append((title(results), *(kept.get(method, _NOT_RUN) for method in NOISY)))
    return markdown(heads, rows)


def linked(page: Path, others: Mapping[str, Path]) -> dict[str, str]:
    """The other pages that exist, as links from `page`."""
    return {name: path.relative_to(page.parent).as_posix() for name, path in others.items() if path.is_file()}
