"""Every command that a page, a comment or the Makefile shows: it starts, and takes what it is shown with."""

from __future__ import annotations

import argparse
import pkgutil
import re
import shlex
import sys
from collections.abc import Iterator
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
import typer

import benchmarks
import evaluation
from benchmarks.reliability.faults.rows import ROWS
from specshield import cli
from specshield.service.settings import Settings

ROOT = Path(__file__).parents[1]
PAGES = {*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *ROOT.glob("benchmarks/**/*.md")}
PAGES -= {ROOT / "CHANGELOG.md"}  # it tells of commands that are gone
PROGRAMS = {file for room in ("app", "benchmarks", "evaluation") for file in ROOT.glob(f"{room}/**/*.py")}
BEGIN = r"(?:\.venv(?:-bench)?/bin/)?(?:python -m (?=benchmarks|evaluation)|specshield (?=[a-z]))"
QUOTED = re.compile(rf"`({BEGIN}[^`]+)`")
LINE = re.compile(rf"^[ \t@-]*(?:test -f \S+ \|\| )?({BEGIN}.*)$", re.MULTILINE)
FENCED = re.compile(r"^```(?:sh|bash)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
APART = {"rtamt", "schemathesis", "stable_baselines3"}  # of benchmarks/requirements.txt alone


def shown(file: Path) -> Iterator[str]:
    """The commands in backticks, and those on lines of their own."""
    text = file.read_text()
    if file.name == "Makefile":
        text = text.replace("$(RELIABILITY)", "python -m benchmarks.reliability").replace("$(BIN)/", "")
        text = re.sub(r"\$\(\w+\)", "x", text.replace(" $(ARGS)", ""))
    yield from (" ".join(found.split()) for found in QUOTED.findall(text))
    for block in FENCED.findall(text) if file.suffix == ".md" else [text]:
        yield from LINE.findall(block.replace("\\\n", " "))


def words(command: str) -> list[str]:
    """What follows `specshield` or `python -m`. What may be left out, in brackets, is given."""
    command = re.split(r" +# | > | \|", command)[0]
    given = shlex.split(re.sub(r"\[\.\.\.\]|\.\.\.| \[(?=-|[A-Z])|\](?= |$)", " ", command))
    return given[2:] if "python" in given[0] else given[1:]


FILES = [*PAGES, *PROGRAMS, ROOT / "Makefile", ROOT / "docker" / "Dockerfile"]
SHOWN = {
    tuple(words(command)): f"{file.relative_to(ROOT)}: {command}"
    for file in sorted(FILES)
    for command in shown(file)
    if "{" not in command
}


RUN_AS_MODULES = [given for given in SHOWN if re.match(r"benchmarks|evaluation\.", given[0])]


def loaded(module: str) -> Any:
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        if error.name in APART:
            return None
        raise


@pytest.mark.parametrize("package", [benchmarks, evaluation], ids=lambda package: package.__name__)
def test_every_module_finds_what_it_imports(package):
    for found in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
        loaded(found.name)


class Taken(Exception):
    """The arguments were taken."""


@pytest.mark.parametrize("given", RUN_AS_MODULES, ids=" ".join)
def test_a_program_takes_what_it_is_shown_with(given, monkeypatch, capsys):
    module, *arguments = given
    path = ROOT.joinpath(*module.split("."))
    program = loaded(f"{module}.__main__" if path.is_dir() else module)
    if not hasattr(program, "argparse"):
        assert '__name__ == "__main__"' in Path(program.__file__).read_text()
        assert not any(word.startswith("-") for word in arguments), SHOWN[given]
        return

    def taken(parser, *_):
        # 1 is the value of an option that is named without one.
        _, left = parser.parse_known_args([*arguments, "1"])
        assert left in ([], ["1"]), SHOWN[given]
        raise Taken

    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", taken)
    monkeypatch.setattr(sys, "argv", [module])
    with pytest.raises((Taken, SystemExit)) as ended:
        program.main()
    assert ended.type is Taken or not ended.value.code, f"{SHOWN[given]}: {capsys.readouterr().err}"


def test_the_faults_that_a_page_names_are_there():
    for given, where in SHOWN.items():
        if "--rows" in given:
            assert set(given[given.index("--rows") + 1].split(",")) <= ROWS.keys(), where


@cache
def commands() -> dict[str, Any]:
    """Those of `specshield`, by name. `python -m evaluation` has some of them."""
    app = typer.Typer()
    for command in cli._commands():
        if isinstance(command, typer.Typer):
            app.add_typer(command)
        else:
            app.command(command.__name__.removesuffix("_policy").replace("_", "-"))(command)
    return dict(typer.main.get_command(app).commands)


def options(command: Any) -> set[str]:
    return {option for each in command.params for option in each.opts}


@pytest.mark.parametrize("given", [each for each in SHOWN if each not in RUN_AS_MODULES], ids=" ".join)
def test_a_command_takes_what_it_is_shown_with(given):
    name, *arguments = given[1:] if given[0] == "evaluation" else given
    command = commands()[name]
    if arguments and hasattr(command, "commands"):  # `keys create`
        command = command.commands[arguments.pop(0)]
    asked = {word.partition("=")[0] for word in arguments if word.startswith("--")}
    assert asked <= options(command), SHOWN[given]


@pytest.mark.parametrize("page", sorted(PAGES), ids=lambda page: page.name)
def test_targets_files_and_settings_that_a_page_names_are_there(page):
    text, make = page.read_text(), (ROOT / "Makefile").read_text()
    for target in re.findall(r"(?:`|^)make ([\w-]+)(?=`| ARGS|  |$)", text, re.MULTILINE):
        assert re.search(rf"^{target}:", make, re.MULTILINE), f"make {target}"
    rooms = "examples|tests|evaluation|benchmarks|app|docs|docker|ros2|models"
    for file in re.findall(rf"\b((?:{rooms})/[\w/.-]+\w)", text):
        assert (ROOT / file).exists() or (page.parent / file).exists(), file
    known = {"REDIS_URL", *(f"SPECSHIELD_{name.upper()}" for name in Settings.model_fields)}
    assert set(re.findall(r"\bSPECSHIELD_[A-Z_]+[A-Z]", text)) <= known
