"""Writes docs/results/uncertainty.md from what its campaigns have printed."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from evaluation.uncertainty.aims import AIMS, shortfalls
from evaluation.uncertainty.plan import plan
from evaluation.uncertainty.sections import Found, sections

INTRODUCTION = """\
# A world that is not as told, measured

Written by `python -m evaluation uncertainty`, which runs the commands below and keeps what they print
([uncertainty.json](uncertainty.json)). With `--only` a part is measured anew and the rest stays.
[Uncertainty](../uncertainty.md) says what a session does in such worlds, and what its bounds assume. All
sessions have the default settings, but where a row says `"none"`: nobody set a margin or a slack by hand. The
rule is judged on true poses. Shares have 95 % Clopper-Pearson intervals; the KL of a run, in nats, has the
95 % interval of a bootstrap over runs. Below each table are its commands, which name the seed and how many
runs, each with the commit at which it was measured and the date. No times are told: other programs ran
beside."""


def write(page: Path, found: Found, seed: int = 0) -> None:
    """Writes the page from the figures that there are; what of the plan is not there is named."""
    parts = [INTRODUCTION, "## What falls short", AIMS, _bullets(shortfalls(found))]
    absent = list(_absent(found, seed))
    if absent:
        parts += ["## What was not measured, or with fewer runs", _bullets(absent)]
    for title, text, names, made in sections(found):
        parts += [f"## {title}", text, *made, commands(found, names)]
    page.parent.mkdir(parents=True, exist_ok=True)
    page.write_text("\n\n".join(parts) + "\n")


def _absent(found: Found, seed: int) -> Iterator[str]:
    for each in plan(seed):
        if each.name not in found:
            yield f"`{each.command()}`"
        elif found[each.name].runs < each.runs:
            yield f"`{each.command()}`: with `{each.counted} {found[each.name].runs}` alone"


def _bullets(lines: Iterable[str]) -> str:
    return "\n".join(f"- {line}" for line in lines) or "- Nothing."


def commands(found: Found, names: Sequence[str]) -> str:
    """A block of the commands of these campaigns, each with the commit and date of its figures."""
    return "\n".join(["```sh", *_commands(found, names), "```"])


def _commands(found: Found, names: Sequence[str]) -> Iterator[str]:
    for name in names:
        yield f"{found[name].command}  # {found[name].commit}, {found[name].date}"
