"""docs/results.md: one table, what the figures are less than they may sound, and where the rest is."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

from evaluation.experiment import split
from evaluation.pages.tables import Found, better, summary_table, title
from evaluation.pages.words import CAVEATS, HOW
from evaluation.results import share


def summary(found: Found, elsewhere: Mapping[str, str], noisy: Found) -> Iterator[str]:
    """found: the main experiments. elsewhere: other pages, {title: path}. noisy: those of the noise page."""
    yield "# Results"
    yield HOW
    yield summary_table(found.values())
    yield "\n".join([CAVEATS, *_noise(noisy)])
    yield from better(found)
    yield "## More"
    yield "\n".join(f"- [{name}]({path})" for name, path in elsewhere.items())
    yield "`make results` makes all of it again; each page ends with its own commands."


def _noise(noisy: Found) -> Iterator[str]:
    """The rule under gaussian noise by `ours` and by others, each pair with the same margin."""
    for results in noisy.values():
        if results["experiment"]["noise"] != "gaussian":
            continue
        kept = {one["method"]: share(one["satisfied"]) for one in results["methods"]}
        parts = [
            f"{(ours := found['other'])} {kept[ours]}, {method} {kept[method]}, "
            f"p = {found['satisfied']['p']:.2g}"
            for method, found in results["beside_ours"].items()
            if split(method)[0] in ("paper", "rule-first")
        ]
        if parts:
            yield f"  - {title(results)}, gaussian noise, rule kept: {'; '.join(parts)}."


def linked(page: Path, others: Mapping[str, Path]) -> dict[str, str]:
    """The other pages that exist, as links from `page`."""
    return {name: path.relative_to(page.parent).as_posix() for name, path in others.items() if path.is_file()}
