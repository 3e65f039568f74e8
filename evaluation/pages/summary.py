"""docs/results.md: one table, what the figures are less than they may sound, and where the rest is."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

from evaluation.experiment import CERTIFYING, split
from evaluation.pages.tables import Found, Results, difference, summary_table, title
from evaluation.pages.words import CAVEATS, HOW, NOT_THE_SAME, PAPER
from evaluation.results import markdown, share

UNLIKELY = 0.05  # a p below it is told


def summary(found: Found, elsewhere: Mapping[str, str], noisy: Found) -> Iterator[str]:
    """found: the main experiments. elsewhere: other pages, {title: path}. noisy: those of the noise page."""
    yield "# Results"
    yield HOW
    yield summary_table(found.values())
    yield "\n".join([CAVEATS, *_noise(noisy)])
    yield "## What does better than ours"
    yield (
        "Methods that keep the rule as well, where the 95 % interval of the difference, run by run, lies "
        "below 0, or McNemar's test of the main task has p < 0.05:"
    )
    yield "\n".join(line for results in found.values() for line in better(results)) or "- None was found."
    yield "## Beside the paper's Table II"
    yield NOT_THE_SAME
    yield _beside(found)
    yield "## More"
    yield "\n".join(f"- [{name}]({path})" for name, path in elsewhere.items())
    yield "`make results` makes all of it again; each page ends with its own commands."


def better(results: Results) -> Iterator[str]:
    """What other methods do better than `ours`, of those that keep the rule as well."""
    for method, found in results["beside_ours"].items():
        kept = found["satisfied"]
        if found["other"] != "ours" or split(method)[0] not in CERTIFYING:
            continue
        if kept["p"] < UNLIKELY and kept["only"] < kept["only_other"]:
            continue
        said = []
        for key, name in (("extra_steps", "steps"), ("kl", "KL")):
            if found[key]["pairs"] and found[key]["difference_high"] < 0.0:
                said.append(f"{name} {difference(found[key])}")
        done = found["main_done"]
        if done["p"] < UNLIKELY and done["only"] > done["only_other"]:
            said.append(f"main task +{done['only']} and -{done['only_other']} runs, p = {done['p']:.2g}")
        if said:
            yield f"- **{method}** ({title(results)}): {'; '.join(said)}."


def _noise(noisy: Found) -> Iterator[str]:
    """The rule under gaussian noise by `ours` and by `paper`, each pair with the same margin."""
    for results in noisy.values():
        if results["experiment"]["noise"] != "gaussian":
            continue
        kept = {one["method"]: share(one["satisfied"]) for one in results["methods"]}
        parts = [
            f"{(ours := found['other'])} {kept[ours]}, {method} {kept[method]}, "
            f"p = {found['satisfied']['p']:.2g}"
            for method, found in results["beside_ours"].items()
            if split(method)[0] == "paper"
        ]
        if parts:
            yield f"  - {title(results)}, gaussian noise, rule kept: {'; '.join(parts)}."


def _beside(found: Found) -> str:
    rows = []
    for results in found.values():
        for one in results["methods"]:
            theirs = PAPER.get(results["case"], {}).get(one["method"])
            if theirs is not None:
                said = (f"{theirs[0]:g} %", f"{theirs[1]:g} %")
                here = (share(one["satisfied"]), share(one["main_done"]))
                rows.append((title(results), one["method"], *said, *here))
    heads = (
        "case, model", "method", "the paper: rule", "the paper: main task", "here: rule", "here: main task",
    )  # fmt: skip
    return markdown(heads, rows)


def linked(page: Path, others: Mapping[str, Path]) -> dict[str, str]:
    """The other pages that exist, as links from `page`."""
    return {name: path.relative_to(page.parent).as_posix() for name, path in others.items() if path.is_file()}
