"""What `specshield train` does: a policy for a case, written where a server finds it."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from specshield.errors import Unsupported
from specshield.policy.dqn.settings import read_settings
from specshield.policy.planner import policy as planner
from specshield.policy.reachability import policy as reachability
from specshield.policy.tensors import replace_file
from specshield.sim.cases import MODELS, Case, load_case
from specshield.sim.progress import StatusLine, duration


def train(
    case: str,
    method: str,
    seed: int,
    updates: int | None,
    options: Sequence[str],
    out: Path | None,
    resume: bool,
) -> int:
    """Makes pi_phi for a case and writes policy.safetensors and card.json to `out`; the exit status.

    options: "name=value", of the method's settings. What a DQN has learned is saved to `out`/checkpoint at
    every evaluation; `resume` takes that up after a kill.
    """
    loaded = load_case(case)
    out = out or MODELS / (loaded.name if method == "reachability" else f"{loaded.name}-{method}")
    if method == "dqn":
        weights, card = _learn(loaded, seed, updates, _options(options), out / "checkpoint", resume)
    elif method == "reachability":
        table = reachability.synthesise(
            loaded.task, reachability.read_settings(_options(options)), dict(loaded.spec)
        )
        weights, card = table.weights(), table.card
    elif method == "planner":
        plans = planner.synthesise(loaded.task, planner.read_settings(_options(options)), dict(loaded.spec))
        weights, card = plans.weights(), plans.card
    else:
        expected = "'dqn', 'planner' or 'reachability'"
        raise Unsupported("unknown method", path="method", got=method, expected=expected)
    out.mkdir(parents=True, exist_ok=True)
    replace_file(out / "policy.safetensors", weights)
    (out / "card.json").write_text(json.dumps(card, indent=1) + "\n")
    shutil.rmtree(out / "checkpoint", ignore_errors=True)
    metrics = card["metrics"]
    alone = f"satisfies alone from {metrics['satisfied']:.1%}, " if "satisfied" in metrics else ""
    print(f"{out}: {alone}feasible from {metrics['feasible_start']:.1%}; {duration(metrics['wall_time_s'])}")
    return 0


def _learn(
    case: Case, seed: int, updates: int | None, options: dict[str, Any], checkpoint: Path, resume: bool
) -> tuple[bytes, dict[str, Any]]:
    from specshield.policy.dqn.train import Progress, train

    settings = read_settings(options | ({} if updates is None else {"updates": updates}))
    status = StatusLine()
    if not resume:
        shutil.rmtree(checkpoint, ignore_errors=True)

    def show(progress: Progress) -> None:
        rate = "not measured yet" if progress.satisfied is None else f"satisfied {progress.satisfied:.1%}"
        done = f"{case.name}: update {progress.update} of {progress.updates}"
        status.say(f"{done}, {rate}, {duration(progress.eta_s)} left")

    policy = train(case.task, settings, seed, show, checkpoint, spec=dict(case.spec))
    status.clear()
    return policy.weights(), policy.card


def _options(texts: Sequence[str]) -> dict[str, Any]:
    """The settings that "name=value" texts name, each value read as JSON or else as the text it is."""
    settings: dict[str, Any] = {}
    for text in texts:
        name, _, value = text.partition("=")
        try:
            settings[name] = json.loads(value)
        except ValueError:
            settings[name] = value
    return settings
