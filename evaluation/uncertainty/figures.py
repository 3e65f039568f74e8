"""Runs campaigns, each as the command that it is, and keeps what they print: a file of JSON for each, and one
beside the page that is written from them.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import time
from collections.abc import Collection, Mapping
from dataclasses import asdict, dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import TypeVar

from pydantic import TypeAdapter, ValidationError

from evaluation.uncertainty.plan import Campaign, plan
from specshield.errors import InputError
from specshield.policy.tensors import replace_file
from specshield.sim.progress import duration

ROOT = Path(__file__).resolve().parents[2]
T = TypeVar("T")
Table = list[dict[str, str]]  # rows, each by the heads of its columns


@dataclass(frozen=True)
class Measured:
    """What a campaign has printed. command: as it was run; commit, date: at and on which it ended."""

    command: str
    commit: str
    date: str
    tables: list[Table]

    @property
    def runs(self) -> int:
        return int(self.command.split()[-1])


ONE, ALL = TypeAdapter(Measured), TypeAdapter(dict[str, Measured])


def carry_out(
    out: Path, only: Collection[str], share: float, seed: int, processes: int
) -> tuple[dict[str, Measured], int]:
    """Runs what `out` does not hold yet; what there is then, by the campaigns' names, and how many failed.

    only: parts of the plan; all, if it is empty. share: of each campaign's runs. Of a campaign that fails it
    is said why; the others are run.
    """
    began, failed = time.monotonic(), 0
    asked = [each for each in plan(seed) if not only or each.part in only]
    for i, each in enumerate(asked, 1):
        kept = read(out, each.name)
        if kept is None or kept.command != each.command(share):
            failed += not run(each, share, out, processes)
        print(f"[{i} of {len(asked)} campaigns, {duration(time.monotonic() - began)}]", flush=True)
    return kept_in(out), failed


def kept_in(out: Path) -> dict[str, Measured]:
    """The figures that a folder holds, by the names of their campaigns."""
    found = {each.name: read(out, each.name) for each in plan()}
    return {name: measured for name, measured in found.items() if measured is not None}


def read(out: Path, name: str) -> Measured | None:
    path = out / f"{name}.json"
    return _checked(ONE, path) if path.exists() else None


def beside(page: Path) -> dict[str, Measured]:
    """The figures from which a page was written, by the names of their campaigns; none if there is no page.

    So a part of the plan can be measured anew, and the rest of the page stays as it is.
    """
    file = page.with_suffix(".json")
    return _checked(ALL, file) if file.exists() else {}


def keep_beside(page: Path, found: Mapping[str, Measured]) -> None:
    """Keeps the figures from which a page was written, as `beside` reads them."""
    replace_file(page.with_suffix(".json"), ALL.dump_json(dict(found), indent=1) + b"\n")


def _checked(kind: TypeAdapter[T], file: Path) -> T:
    try:
        return kind.validate_json(file.read_bytes())
    except ValidationError as error:
        raise InputError(
            f"the file does not hold the figures of campaigns ({error.errors()[0]['msg']})",
            path=str(file),
            expected="what `python -m evaluation uncertainty` has written; remove it to measure them anew",
        ) from error


def run(campaign: Campaign, share: float, out: Path, processes: int) -> bool:
    """Whether a campaign could be run; its figures are kept then."""
    command, commit = campaign.command(share), current_commit()
    print(command, flush=True)
    words = command.split()[1:]
    if campaign.keeps:  # runs of one commit are not taken up at another
        words += ["--out", str((out / "runs" / commit).absolute()), "--processes", str(processes)]
    done = subprocess.run([sys.executable, *words], cwd=ROOT, stdout=subprocess.PIPE, text=True)
    found = tables(done.stdout)
    # `evaluate` ends with 1 where a rule was broken in the exact world, which is a figure as well.
    if not found or done.returncode not in ((0, 1) if words[2] == "evaluate" else (0,)):
        print(f"{command}: ended with {done.returncode}", file=sys.stderr)
        return False
    measured = Measured(command, commit, datetime.now(timezone.utc).date().isoformat(), found)
    out.mkdir(parents=True, exist_ok=True)
    replace_file(out / f"{campaign.name}.json", (json.dumps(asdict(measured), indent=1) + "\n").encode())
    return True


def tables(printed: str) -> list[Table]:
    """The Markdown tables in a text, their cells as they stand."""
    found = list[Table]()
    heads = list[str]()
    for line in printed.splitlines():
        cells = [cell.strip() for cell in line.strip().removeprefix("|").removesuffix("|").split("|")]
        if not line.startswith("|"):
            heads = []
        elif not heads:
            heads = cells
            found.append([])
        elif not re.fullmatch("[-: ]*", "".join(cells)):
            found[-1].append(dict(zip(heads, cells, strict=True)))
    return [table for table in found if table]


def current_commit() -> str:
    """The commit of this checkout, with `-dirty` where a file of it was changed; `unknown` without git."""
    asked = ["git", "describe", "--always", "--dirty", "--abbrev=7", "--exclude=*"]
    try:
        return subprocess.run(asked, cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
