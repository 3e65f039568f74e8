"""How long the code is, and whether it is still as small as the project wants it.

    python -m benchmarks.lines          # the table, and what breaks a bound; exit status 1 if something does
    python -m benchmarks.lines --write  # the same, and the counts in docs/architecture.md anew

Lines are counted as ruff would format the code if no `fmt: skip` kept it from that. So only less code makes
the count smaller, and another layout does not. The bounds keep the part that has to be right for the
guarantee small enough to read in an afternoon, and every other part small enough to find one's way in.
"""

from __future__ import annotations

import argparse
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[1]
APP = REPOSITORY / "app"
PACKAGE = APP / "specshield"
PAPER = REPOSITORY / "docs" / "architecture.md"  # it names each module of the trusted core with its lines
TRUSTED = ("stl", "world", "robot", "task.py", "rule", "shield", "episode")  # what the guarantee rests on
MOST_TRUSTED = 5_420  # lines of the trusted core
AIM = 17_000  # lines of app/ that the project wants to come down to
MOST = 40_324
LONGEST = 350  # lines of one module
FULLEST = 14  # files in one folder, at one level


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--write", action="store_true", help="write the counts into docs/architecture.md")
    write = parser.parse_args().write
    lines = formatted(APP)
    rooms = sorted({file.relative_to(PACKAGE).parts[0] for file in lines} - set(TRUSTED))
    print("The trusted core, module by module:")
    for room in TRUSTED:
        show(room, below(lines, PACKAGE / room))
        for file in lines:
            if file.parent == PACKAGE / room and file.name != "__init__.py":
                show(f"  {file.name}", lines[file])
    print("The rest:")
    for room in rooms:
        show(room, below(lines, PACKAGE / room))
    trusted = sum(below(lines, PACKAGE / room) for room in TRUSTED)
    print()
    show("The trusted core", trusted, f" of at most {MOST_TRUSTED:,}")
    show("app/", sum(lines.values()), f" of at most {MOST:,}; the aim is {AIM:,}")
    said = PAPER.read_text()
    counted = recount(said, lines, trusted)
    if write:
        PAPER.write_text(counted)
        said = counted
    broken = list(breaches(lines, trusted))
    if said != counted:
        broken.append("docs/architecture.md gives other counts: python -m benchmarks.lines --write")
    for breach in broken:
        print(breach, file=sys.stderr)
    return 1 if broken else 0


def show(name: str, lines: int, more: str = "") -> None:
    print(f"{name:24}{lines:>7,}{more}")


def modules(folder: Path) -> list[Path]:
    return sorted(file for file in folder.rglob("*.py") if "__pycache__" not in file.parts)


def formatted(folder: Path) -> dict[Path, int]:
    """The lines of each module, as ruff would format it if nothing kept it from that."""
    with tempfile.TemporaryDirectory() as name:
        copy = Path(name)
        shutil.copy(REPOSITORY / "pyproject.toml", copy)
        copies = {}
        for file in modules(folder):
            copies[file] = copy / "app" / file.relative_to(folder)
            copies[file].parent.mkdir(parents=True, exist_ok=True)
            copies[file].write_text(re.sub(r"\s*# fmt: (skip|on|off)", "", file.read_text()))
        ruff = [Path(sys.executable).with_name("ruff"), "format", "--quiet", "--no-cache", copy / "app"]
        subprocess.run(ruff, check=True)
        return {file: copies[file].read_bytes().count(b"\n") for file in copies}


def below(lines: dict[Path, int], place: Path) -> int:
    """The lines of a module, or of all modules in a folder."""
    return sum(count for file, count in lines.items() if file.is_relative_to(place))


def recount(text: str, lines: dict[Path, int], trusted: int) -> str:
    """The paper's text with the counts of today in its table and in the sentence before it."""

    def count(row: re.Match[str]) -> str:
        stars, name = row["stars"], row["name"]
        if name == "together":
            return f"| {stars}together{stars} | {stars}{trusted:,}{stars} |"
        return f"| {stars}`{name}`{stars} | {stars}{below(lines, PACKAGE / name):,}{stars} |"

    text = re.sub(r"grows beyond [\d,]+ lines", f"grows beyond {trusted:,} lines", text)
    row = (
        r"^\| (?P<stars>\**)`?(?P<name>together|[\w/]+(\.py|/))`?(?P=stars) \| (?P=stars)[\d,]+(?P=stars) \|"
    )
    return re.sub(row, count, text, flags=re.MULTILINE)


def breaches(lines: dict[Path, int], trusted: int) -> Iterator[str]:
    """What breaks a bound, one sentence each."""
    if trusted > MOST_TRUSTED:
        yield f"the trusted core has {trusted:,} lines; expected at most {MOST_TRUSTED:,}"
    if sum(lines.values()) > MOST:
        yield f"app/ has {sum(lines.values()):,} lines; expected at most {MOST:,}"
    for file, count in lines.items():
        if count > LONGEST:
            yield f"{file.relative_to(REPOSITORY)} has {count} lines; expected at most {LONGEST}"
    for folder in sorted({file.parent for file in lines}):
        files = [each for each in folder.iterdir() if each.is_file() and not each.name.startswith(".")]
        if len(files) > FULLEST:
            shown = folder.relative_to(REPOSITORY)
            yield f"{shown} holds {len(files)} files; expected at most {FULLEST} at one level"


if __name__ == "__main__":
    sys.exit(main())
