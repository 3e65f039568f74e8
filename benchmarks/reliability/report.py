"""docs/reliability.md, from the figures that are there.

A part that was not measured anew stays as the page has it, with the run that it came from; so does a row of
faults.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.reliability.elsewhere import MODULES
from benchmarks.reliability.faults.check import COUNTS
from benchmarks.reliability.figures import ROOT, read

PAGE = ROOT / "docs" / "reliability.md"
FRAME = Path(__file__).with_name("page.md")
ASKED_AWAY = 3.0  # [s] most that a fault may keep a robot waiting, kernels cached
NOT_RUN = "Not run."
RUNS = ("load", "isolation", "fuzz", "contract")


def run(out: Path, page: Path) -> int:
    from benchmarks.reliability.faults.rows import ROWS

    rows, known = list(ROWS), page.read_text() if page.exists() else ""
    measured = [name for name in (*RUNS, *MODULES) if read(out, name) is not None]
    fresh = [name for name in rows if read(out, f"fault-{name}") is not None]
    measured += [f"fault-{name}" for name in fresh]
    faults = {"faults": _faults(out, rows), "races": _races(out), "training": _training(out)}
    if len(fresh) == len(rows):
        faults["summary"] = _summary(out, rows)
    else:
        faults = {name: _merged(_part(known, name), table) for name, table in faults.items()}
        faults["summary"] = _summed(faults["faults"])
    makers = {"load": _load, "isolation": _isolation, "fuzz": _fuzz, "contract": _contract}
    parts = faults | {name: make(out) for name, make in makers.items() if name in measured}
    parts |= {name: _other(out, name) for name in MODULES if name in measured}
    parts["runs"] = _runs(out, measured, _part(known, "runs"))
    others = "\n\n".join(
        f"`python -m benchmarks.{name}`: {what}.\n\n<!-- {name} -->" for name, what in MODULES.items()
    )
    text = FRAME.read_text().replace("<!-- others -->", others)
    for name in re.findall(r"<!-- (\w+) -->", text):
        lines = parts.get(name) or _part(known, name) or [NOT_RUN]
        whole = "\n".join([f"<!-- {name} -->", "", *lines, "", f"<!-- end of {name} -->"])
        text = text.replace(f"<!-- {name} -->", whole)
    page.write_text(text)
    print(page)
    return 0


def _merged(before: Sequence[str], fresh: Sequence[str]) -> list[str]:
    """The lines of a table, of which those that begin with the same cell as a fresh one give way to it."""
    new = {line.split(" | ")[0]: line for line in fresh[2:]}
    return [new.get(line.split(" | ")[0], line) for line in before]


def _summed(table: Sequence[str]) -> list[str]:
    """The sums of this table of faults; nothing where no row was run to its end."""
    rows = [line.strip("| ").split(" | ") for line in table[2:]]
    rows = [row for row in rows if len(row) > 4]
    if not rows:
        return []
    faults, steps = (sum(int(row[i].replace(",", "")) for row in rows) for i in (1, 2))
    bad = [sum(int(row[4].split(" / ")[i]) for row in rows) for i in range(len(COUNTS))]
    told = ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in zip(COUNTS, bad, strict=True))
    return [
        f"Over all rows that were run to their end: {faults:,} faults, {steps:,} acknowledged steps: {told}."
    ]


def _part(page: str, name: str) -> list[str]:
    """The lines of a part as the page has them; none where it has no such part."""
    found = re.search(rf"<!-- {name} -->\n\n(.*?)\n\n<!-- end of {name} -->", page, re.DOTALL)
    return found[1].splitlines() if found else []


def table(head: list[str], rows: list[list[Any]]) -> Iterator[str]:
    yield "| " + " | ".join(head) + " |"
    yield "|" + "---|" * len(head)
    for row in rows:
        yield "| " + " | ".join("" if cell is None else str(cell) for cell in row) + " |"


def _summary(out: Path, names: list[str]) -> list[str]:
    """One line: over all rows, how many faults and steps, and what was lost."""
    found = [row for name in names if (row := read(out, f"fault-{name}")) and "failed" not in row]
    if not found:
        return [NOT_RUN]
    faults = sum(
        row.get(key, 0) for row in found for key in ("kills", "stops", "races", "times_full", "moves")
    )
    steps = sum(row.get("steps", 0) for row in found)
    bad = {name: sum(row.get(name, 0) for row in found) for name in COUNTS}
    told = ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in bad.items())
    missing = [name for name in names if name not in {row["row"] for row in found}]
    lines = [
        f"Over all rows that were run to their end: {faults:,} faults and races, "
        f"{steps:,} acknowledged steps: {told}."
    ]
    return lines + ([f"Not run, or not to the end: {', '.join(missing)}."] if missing else [])


def _faults(out: Path, names: list[str]) -> list[str]:
    rows = list[list[Any]]()
    for name in names:
        figures = read(out, f"fault-{name}")
        if figures is None:
            rows.append([name, NOT_RUN])
        elif "failed" in figures:
            rows.append([figures["what"], f"Not to the end: {figures['failed'][:120]}"])
        elif "away_all_s" in figures:
            faults = next(figures[key] for key in ("kills", "stops", "times_full", "moves") if key in figures)
            away = figures["away_all_s"]
            bad = [figures[count] for count in COUNTS]
            rows.append(
                [figures["what"], faults, f"{figures['steps']:,}", figures["episodes"],
                 " / ".join(map(str, bad)), f"{away['median']:.2f}", f"{away['max']:.2f}", _more(figures)]
            )  # fmt: skip
    head = ["fault", "times", "steps", "episodes",
            "lost / doubled / changed / decided otherwise / violated / stuck", "away, median [s]",
            "away, longest [s]", "and"]  # fmt: skip
    return list(table(head, rows))


def _more(figures: Mapping[str, Any]) -> str:
    told = list[str]()
    if "exit_s" in figures:
        told.append(
            f"exit status other than 0: {figures['exit_not_0']}; exit within {figures['exit_s']['max']:.1f} s"
        )
        told.append(f"answers that cannot be asked for again: {figures['not_retriable']}")
    if "replaced_s" in figures:
        told.append(f"replaced after {figures['replaced_s']['median']:.1f} s")
    if "readyz_503" in figures:
        told.append(f"/readyz 503 in {figures['readyz_503']} of {figures['kills']}")
    if figures.get("refusal_s"):
        told.append(f"refused within {figures['refusal_s']['max']:.1f} s")
    if "answers_while_full" in figures:
        told.append(
            f"while full: {_pairs(figures['answers_while_full'])}; answers of 500: {figures['server_errors']}"
        )
    if "left_in_store" in figures:
        told.append(f"sessions left in the store: {figures['left_in_store']}")
    return "; ".join(told)


def _races(out: Path) -> list[str]:
    rows = list[list[Any]]()
    for name in ("replicas", "same_step", "different_steps", "creates"):
        figures = read(out, f"fault-{name}")
        if figures and "failed" not in figures:
            rows.append(
                [figures["what"], figures["races"], figures["not_one_winner"], figures.get("changed", "")]
            )
        else:
            rows.append([name, NOT_RUN])
    return list(table(["race", "times", "not as promised", "changed afterwards"], rows))


def _training(out: Path) -> list[str]:
    rows = list[list[Any]]()
    for name in ("run_killed", "worker_killed"):
        figures = read(out, f"fault-{name}")
        if figures and "failed" not in figures:
            said, again = figures["failed_after_s"], figures["trains_again_after_s"]
            rows.append(
                [figures["what"], figures["kills"], figures["failed_without_reason"],
                 f"{said['median']:.1f} / {said['max']:.1f}", f"{again['median']:.1f} / {again['max']:.1f}"]
            )  # fmt: skip
        else:
            rows.append([name, NOT_RUN])
    head = [
        "fault",
        "times",
        "without a reason",
        "`failed` after, median / longest [s]",
        "trains again after, median / longest [s]",
    ]
    return list(table(head, rows))


def _load(out: Path) -> list[str]:
    found = read(out, "load")
    assert found is not None
    took, cpu = found["took_ms"], found["cpu_ms_a_step"]
    pace = f"each at {found['rate']:g} Hz" if found["rate"] else "each as fast as it is answered"
    lines = [
        f"{found['robots']} robots for {found['seconds'] / 60:.0f} minutes, {pace}: "
        f"{found['steps']:,} steps, {found['steps_a_second']:.0f} a second. "
        f"Answers other than 200 and 201: {found['not_200']}. "
        f"p50 {took['p50']:.1f} ms, p99 {took['p99']:.1f} ms; p99 of the first {found['edge_s']:.0f} s "
        f"{found['p99_first_ms']:.1f} ms, of the last {found['p99_last_ms']:.1f} ms "
        f"({found['p99_last_to_first']:.2f} times). CPU a step: server {cpu['server_cpu_s']:.2f} ms, "
        f"store {cpu['store_cpu_s']:.2f} ms.",
        "",
    ]
    rows = [
        [
            name,
            *(found[f"{name}_mb"][key] for key in ("first", "middle", "last", "most", "slope_mb_a_minute")),
        ]
        for name in ("server", "store")
    ]
    return lines + list(
        table(["memory [MB]", "at first", "halfway", "at last", "most", "slope, second half [MB/min]"], rows)
    )


def _isolation(out: Path) -> list[str]:
    found = read(out, "isolation")
    assert found is not None
    rows = [
        [row["attack"].replace("_", " "), row["p99_quiet_ms"], row["p99_attack_ms"], row["p99_limit_ms"],
         "yes" if row["isolated"] else "**no**", row["memory_before_mb"], row["memory_most_mb"],
         row["memory_after_mb"], row["memory_after_s"], "yes" if row["memory_back"] else "**no**"]
        for row in found["rows"]
    ]  # fmt: skip
    head = ["attack", "p99 quiet [ms]", "p99 under it [ms]", "asked: at most [ms]", "kept",
            "memory before [MB]", "most [MB]", "after [MB]", "after [s]", "back within 10 %"]  # fmt: skip
    return list(table(head, rows))


def _fuzz(out: Path) -> list[str]:
    found = read(out, "fuzz")
    assert found is not None
    rows = [
        [name, f"{each['inputs']:,}", f"{each['accepted'] / each['inputs']:.0%}",
         each["finds"].get("crash", 0), each["finds"].get("slow", 0) + each["finds"].get("hang", 0),
         each["finds"].get("large", 0), f"{1e3 * each['slowest_s']:.0f}", each["largest_mb"]]
        for name, each in sorted(found["targets"].items())
    ]  # fmt: skip
    total = sum(each["inputs"] for each in found["targets"].values())
    head = [
        "reader",
        "inputs",
        "accepted",
        "crashes",
        "over 1 s of CPU",
        "over 200 MB",
        "slowest [ms]",
        "largest [MB]",
    ]
    return [f"{total:,} inputs, seed {found['seed']}.", "", *table(head, rows)]


def _contract(out: Path) -> list[str]:
    found = read(out, "contract")
    assert found is not None
    failures = ", ".join(f"{name}: {count}" for name, count in found["failures"].items()) or "none"
    return [
        f"{found['tool']}, all checks, all phases and links: {found['cases']:,} cases. Answers by status: "
        f"{_pairs(found['answers'])}. Failures: {failures}. "
        f"Tracebacks in the server's log: {found['tracebacks']}."
    ]


def _other(out: Path, name: str) -> list[str]:
    """What a module of elsewhere.py printed."""
    found = read(out, name)
    assert found is not None
    return [f"Exit status {found['status']}.", "", "```", *found["lines"], "```"]


def _runs(out: Path, measured: Sequence[str], before: Sequence[str]) -> list[str]:
    """Command, machine and commit of every part, alike ones together. before: the lines that the page has, of
    which those of parts that were measured anew go.
    """
    alike: dict[str, list[str]] = {}
    for line in before:
        key, _, parts = line.removeprefix("- ").partition(": ran ")
        stays = [part for part in re.findall(r"[\w-]+ \([^)]*\)", parts) if part.split()[0] not in measured]
        if stays:
            alike[key] = stays
    for name in measured:
        found = read(out, name)
        if found is None or "machine" not in found:
            continue
        machine = found["machine"]
        size = f"{machine['cores']} cores, {machine['memory_gib']} GiB"
        where = f"{machine['cpu']}, {size}, Python {machine['python']}"
        key = f"`{found['command']}` at commit {found['commit']}: {where}"
        alike.setdefault(key, []).append(f"{name} ({found['when']}, load {machine['load']:.1f})")
    return [f"- {key}: ran {', '.join(parts)}" for key, parts in alike.items()]


def _pairs(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{name} {count:,}" for name, count in counts.items())
