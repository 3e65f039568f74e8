"""`specshield train`: makes a policy for a case, and writes it where a server finds it."""

from __future__ import annotations

import fcntl
import json
import os
import shutil
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer

from specshield.errors import InputError, PolicyError


def train(
    case: Annotated[str, typer.Option(help="A case of maps/, such as 1 or case1.")],
    method: Annotated[
        str, typer.Option(help="reachability, planner, dqn, or one of another package.")
    ] = "reachability",
    seed: Annotated[int, typer.Option(help="Seed of everything random.", min=0)] = 0,
    updates: Annotated[int | None, typer.Option(help="Updates of the network.", min=1)] = None,
    option: Annotated[list[str] | None, typer.Option(help="An option, as in units=128; repeatable.")] = None,
    out: Annotated[Path | None, typer.Option(help="Folder; by default a new one in models/.")] = None,
    resume: Annotated[bool, typer.Option(help="Go on with a run that was killed.")] = False,
) -> None:
    """Make a policy for a case. Methods that learn show their progress."""
    from specshield.policy.methods import DEFAULT, METHODS, Run
    from specshield.policy.options import read_options
    from specshield.policy.tensors import replace_file
    from specshield.shipped import MODELS
    from specshield.sim.cases import load_case
    from specshield.sim.progress import StatusLine, duration

    began, made_by, loaded = time.monotonic(), METHODS.get(method), load_case(case)
    given = _parse(option or []) | ({} if updates is None else {"updates": updates})
    try:
        chosen = read_options(made_by.options, given)
    except PolicyError as error:  # it names a field of a request
        name = str(error.path).removeprefix("options.")
        error.path = "--updates" if name == "updates" and updates is not None else f"--option {name}"
        raise
    own = MODELS / (loaded.name if method == DEFAULT else f"{loaded.name}-{method}")
    if out is None and (own / "policy.safetensors").exists():
        expected = f"a folder to write to; --out {own} replaces that policy"
        raise InputError(f"{own} holds a policy already", path="--out", expected=expected)
    out = out or own
    checkpoint, status = out / "checkpoint", StatusLine()

    def show(done: float, seconds_left: float, said: str) -> None:
        status.say(f"{loaded.name}: {said or f'{done:.0%}'}, {duration(seconds_left)} left")

    out.mkdir(parents=True, exist_ok=True)
    with _alone_in(out):
        if not resume:
            shutil.rmtree(checkpoint, ignore_errors=True)
        policy = made_by.make(loaded.task, chosen, Run(seed, dict(loaded.spec), checkpoint, show))
        status.clear()
        replace_file(out / "policy.safetensors", policy.weights())
        (out / "card.json").write_text(json.dumps(policy.card, indent=1) + "\n")
        shutil.rmtree(checkpoint, ignore_errors=True)
    measured = {"satisfied": "satisfies alone from", "feasible_start": "feasible from"}
    metrics = policy.card["metrics"]
    shares = [f"{words} {metrics[name]:.1%}" for name, words in measured.items() if name in metrics]
    print(f"{out}: {', '.join(shares)}; {duration(time.monotonic() - began)}")


@contextmanager
def _alone_in(folder: Path) -> Iterator[None]:
    """Raises InputError if another process is in such a block: each would remove the other's checkpoint."""
    opened = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(opened, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            told = f"another `specshield train` makes a policy in {folder}"
            expected = "another folder, or that the other command ends first"
            raise InputError(told, path="--out", expected=expected) from None
        yield
    finally:
        os.close(opened)


def _parse(texts: Sequence[str]) -> dict[str, Any]:
    """The options in texts "name=value", each value read as JSON, or else as text."""
    found: dict[str, Any] = {}
    for text in texts:
        name, _, value = text.partition("=")
        try:
            found[name] = json.loads(value)
        except ValueError:
            found[name] = value
    return found
