"""Pages with experiments one by one, each with its table and, if it has any, its pictures."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from evaluation.experiment import CERTIFYING, split
from evaluation.figures import WAYS
from evaluation.pages.tables import Found, Results, about, beside_ours, better, summary_table, title
from evaluation.pages.words import MODELS, NOT_THE_SAME, PAPER, WHY_NEXT_STEP
from evaluation.results import markdown, share, table


def overview(found: Found) -> Iterator[str]:
    """One table of all experiments, who the models are, and how methods do beside `ours` in each."""
    yield summary_table(found.values())
    yield models(found)
    yield from better(found)
    for results in found.values():
        yield f"## {title(results)}"
        yield about(results)
        yield "\n".join([*beside_ours(results), *_left(results)])


def one_by_one(found: Found, drawn: Mapping[Path, Sequence[Path]], page: Path) -> Iterator[str]:
    """Each experiment's own table, why rules and tasks were not kept, and its pictures.

    drawn: the pictures of an experiment, by its folder; page: the page that they are shown on.
    """
    yield models(found)
    yield from better(found)
    yield (
        f"In the pictures of ways, which show the first {WAYS} runs, blue runs kept the rule and orange ones "
        "did not; what came after the rule's horizon is grey. A line is the median of the runs, and the band "
        "around it the middle 80 %."
    )
    for kept, results in found.items():
        yield f"## {title(results)}"
        yield about(results)
        yield table(results)
        yield "\n".join([*_missed(results), *beside_ours(results), *_left(results)])
        for path in drawn.get(kept, ()):
            yield f"![{path.stem} of {title(results)}]({path.relative_to(page.parent)})"
    yield WHY_NEXT_STEP
    yield "## The paper's Table II"
    yield NOT_THE_SAME
    yield _beside_paper(found)


def models(found: Found) -> str:
    used = dict.fromkeys(results["experiment"]["model"] for results in found.values())
    return "\n".join(["The models know no rule:", "", *(f"- **{name}**: {MODELS[name]}" for name in used)])


def _missed(results: Results) -> Iterator[str]:
    """Which conjuncts each method did not keep, and why main tasks were not done."""
    for one in results["methods"]:
        parts = []
        if one["broken"]:
            broken = (f"`{part}` {n}" for part, n in sorted(one["broken"].items()))
            parts.append(f"broken in runs: {', '.join(broken)}")
        missed = one["runs"] - one["main_done"]["count"]
        if missed:
            parts.append(
                f"main task not done in {missed}: never ended {one['never_ended']}, ended elsewhere "
                f"{one['ended_elsewhere']}"
            )
        parts += _below_unmodified(one)
        if parts:
            yield f"- {one['method']}: {'; '.join(parts)}."


def _below_unmodified(one: Mapping[str, Any]) -> Iterator[str]:
    common = one["common"]
    if common["runs"] and split(one["method"])[0] in CERTIFYING:
        points = 100 * (common["unmodified"] - common["main_done"]) / common["runs"]
        over = "" if common["runs"] == one["runs"] else f" over the {common['runs']} runs that both have"
        yield f"main task {points:+.1f} points below unmodified{over}"


def _left(results: Results) -> Iterator[str]:
    left = results["left"]
    if left["of"]:
        yield (
            f"- A rule may keep the model from its task until the horizon. In the {left['steps']} steps "
            f"that are then left, unmodified does its task in {left['done']} of {left['of']} runs."
        )


def _beside_paper(found: Found) -> str:
    """The paper's Table II, apart from our own tables."""
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
