"""Writes the pages of results from the files of `specshield evaluate --out`.

Every figure in the pages is read from a results.json; the words around them are in pages/words.py. The page
asked for summarises; the others lie in a folder beside it, in which other commands write pages too.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

from evaluation import figures
from evaluation.evaluation import read
from evaluation.experiment import Experiment
from evaluation.pages.details import one_by_one, overview
from evaluation.pages.houses import bodies, houses
from evaluation.pages.noise import noise
from evaluation.pages.summary import linked, summary
from evaluation.pages.tables import Results, commands
from evaluation.pages.words import INTRODUCTION, MAIN_MODELS, TASKS, TIMES, legend
from evaluation.results import write
from specshield.errors import NotFound
from specshield.sim.cases import Case

TITLES = {  # of the pages in a folder beside the summary
    "cases": "The cases, method by method",
    "models": "Other models",
    "tasks": "Harder main tasks",
    "noise": "Noise, and worlds that are not as told",
    "houses": "Other apartments",
    "bodies": "Keep-outs for the body and for the origin",
}
UNTOLD = "A world that is not as told, by a session's defaults"
OTHERS = {  # pages beside the summary that commands of their own write
    "rewards": "The paper's reward to the letter, and seeds",
    "curves": "Thresholds below 1",
    "habits": "Does closeness to the model matter?",
    "lookahead": "Look-ahead",
    "rivals": "Look-ahead beside slacks",
    "related": "The neighbours",
}


def write_up(folder: Path, page: Path) -> None:
    """Writes the page, and beside it those of TITLES that there is something for, with their pictures.

    folder: as `specshield evaluate --out` was given, or one that holds such folders, one a model. Raises
    NotFound where it holds no results.
    """
    written = [*folder.glob("*/*/runs.jsonl"), *folder.glob("*/*/*/runs.jsonl")]
    found = {runs.parent: write(runs.parent) for runs in sorted(written)}
    if not found:
        raise NotFound(
            "there are no results", path="results", got=str(folder),
            expected="a folder that `specshield evaluate --out` has written",
        )  # fmt: skip
    beside = page.with_suffix("")
    beside.mkdir(parents=True, exist_ok=True)
    parts = {name: {kept: r for kept, r in found.items() if name in pages_of(r)} for name in TITLES}
    texts = {
        "models": overview(parts["models"]),
        "tasks": [TASKS, *overview(parts["tasks"])],
        "noise": noise(parts["noise"]),
        "houses": houses(parts["houses"]),
        "bodies": bodies(parts["bodies"]),
    }
    drawn = {
        kept: figures.draw(_case(results), read(kept), beside / kept.parent.relative_to(folder))
        for kept, results in parts["cases"].items()
    }
    texts["cases"] = one_by_one(parts["cases"], drawn, beside / "cases.md")
    for name, text in texts.items():
        if parts[name]:
            write_page(
                beside / f"{name}.md",
                [
                    f"# {TITLES[name]}",
                    INTRODUCTION if name != "cases" else f"{INTRODUCTION} {TIMES}",
                    legend(_methods(parts[name].values())),
                    *text,
                    "## How it was run",
                    commands(folder, parts[name]),
                ],
            )
    others = {title: beside / f"{name}.md" for name, title in TITLES.items()}
    others |= {UNTOLD: beside / "uncertainty.md"}  # by `python -m evaluation uncertainty`
    others |= {title: page.with_name(f"{name}.md") for name, title in OTHERS.items()}
    write_page(page, summary(parts["cases"], linked(page, others), parts["noise"], parts["tasks"]))


def pages_of(results: Results) -> set[str]:
    """The pages that an experiment is shown on."""
    asked = results["experiment"]
    if asked["noise"] != "none":
        return {"noise"}
    if asked["house"] is not None:
        return {"houses"}
    if "touches(" in results["formula"]:
        return {"bodies"}
    if "-" in results["case"]:
        return {"tasks"}
    if asked["model"] not in MAIN_MODELS:
        return {"models"}
    shown = {"cases"}
    if "not Forbidden" in results["formula"] and asked["model"] == MAIN_MODELS[0]:
        shown.add("bodies")
    return shown


def _case(results: Results) -> Case:
    return Experiment.from_json(results["experiment"]).setting.case


def _methods(found: Iterable[Results]) -> list[str]:
    return [one["method"] for results in found for one in results["methods"]]


def write_page(page: Path, parts: Iterable[str]) -> None:
    """Writes the page. A link to a page that is not there is its words alone."""
    text = "\n\n".join(part for part in parts if part) + "\n"

    def told(link: re.Match[str]) -> str:
        return link[0] if (page.parent / link[2]).is_file() else link[1]

    page.write_text(re.sub(r"\[([^]]+)\]\(([^)]+\.md)\)", told, text))
