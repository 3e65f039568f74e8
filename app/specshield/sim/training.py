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
from typing import Any

from specshield.errors import InputError, PolicyError
from specshield.policy.methods import DEFAULT, METHODS, Run
from specshield.policy.options import read_options
from specshield.policy.tensors import replace_file
from specshield.shipped import MODELS
from specshield.sim.cases import load_case
from specshield.sim.progress import StatusLine, duration


def train(
    case: str,
    method: str,
    seed: int,
    updates: int | None,
    options: Sequence[str],
    out: Path | None,
    resume: bool,
) -> None:
    """Makes pi_phi for a case and writes policy.safetensors and card.json to `out`, by default a folder of
    models/ that has no policy yet.

    options: "name=value" for options of the method. A method may save checkpoints in `out`/checkpoint, from
    which `resume` goes on after a kill.
    """
    began, made_by, loaded = time.monotonic(), METHODS.get(method), load_case(case)
    given = _parse(options) | ({} if updates is None else {"updates": updates})
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
