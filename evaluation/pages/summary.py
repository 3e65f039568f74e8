"""docs/results.md, in three screens: a table a case, what it is less than it may sound, where the rest is."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from evaluation.pages.tables import Found, Results, better_in_short, title
from evaluation.pages.words import CAVEATS, HOW, SHORT
from evaluation.results import markdown, share

FRONT = ("unmodified", "rcd+", "simplex", "rule-first", "paper", "ours", "ours@0/25", "lookahead")
NOISY = ("ours", "paper", "rule-first", "ours@default", "paper@default")


def summary(found: Found, elsewhere: Mapping[str, str], noisy: Found) -> Iterator[str]:
    """found: the main experiments. elsewhere: other pages, {title: path}. noisy: those of the noise page."""
    yield "# Results"
    yield HOW
    yield SHORT
    for case in dict.fromkeys(results["case"] for results in found.values()):
        yield from _case([results for results in found.values() if results["case"] == case])
    yield CAVEATS
    yield _noise([each for each in noisy.values() if each["experiment"]["noise"] == "gaussian"])
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
