"""docs/results.md, in three screens: one table, what it is less than it may sound, where the rest is."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from evaluation.pages.tables import Found, Results, better_in_short, summary_table, title
from evaluation.pages.words import CAVEATS, HOW, SHORT
from evaluation.results import markdown, share

FRONT = ("unmodified", "rcd+", "simplex", "rule-first", "paper", "ours", "ours@0/25", "lookahead")
NOISY = ("ours", "paper", "rule-first", "ours@default", "paper@default")


def summary(found: Found, elsewhere: Mapping[str, str], noisy: Found) -> Iterator[str]:
    """found: the main experiments. elsewhere: other pages, {title: path}. noisy: those of the noise page."""
    yield "# Results"
    yield HOW
    told = {one["case"]: (one["formula"], one["instruction"]) for one in found.values()}
    yield "\n".join(
        f'- **{case}**: `{rule}`; the model is told "{task}".' for case, (rule, task) in told.items()
    )
    yield SHORT
    yield summary_table(found.values(), FRONT)
    yield CAVEATS
    yield _noise([each for each in noisy.values() if each["experiment"]["noise"] == "gaussian"])
    yield from better_in_short(found)
    yield "## More"
    yield "\n".join(f"- [{name}]({path})" for name, path in elsewhere.items())
    yield "`make results` makes all of it again; each page of figures names its own command."


def _noise(noisy: Sequence[Results]) -> str:
    """How many runs keep the rule under gaussian noise, a row a case."""
    if not noisy:
        return ""
    heads = ("gaussian noise, rule kept", *NOISY)
    rows = []
    for results in noisy:
        kept = {one["method"]: share(one["satisfied"]) for one in results["methods"]}
        rows.append((title(results), *(kept.get(method, "not run") for method in NOISY)))
    return markdown(heads, rows)


def linked(page: Path, others: Mapping[str, Path]) -> dict[str, str]:
    """The other pages that exist, as links from `page`."""
    return {name: path.relative_to(page.parent).as_posix() for name, path in others.items() if path.is_file()}
