"""Trains the learned model, measures it and writes it: `python -m evaluation.model.command --help`.

The model in models/fm was trained twice in a row, both times in generated apartments alone: with the default
options and `--out first`, and then with `--start first --seed 1 --option own=0.7 --option rounds=200 --option
houses=300 --option learning_rate=7e-4`. The code has changed since the first training, so these commands make
a model of the same kind, not the same bits: the network then drove for 160 steps at most, nothing made it
less likely to repeat an action that had changed nothing, and the gradients were of half precision. With the
code as it is, a command gives the same bits again on one machine with one version of torch.

The training interferes with the robots (practice.py): what the model is later shielded with is not new to it.
The model in models/fm-unsteered was trained once, with `--option interference=false`: nothing but the expert
and the network itself ever chose an action.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from evaluation.apartments import APARTMENTS
from evaluation.model.floor_plans import House, random_house
from evaluation.model.measure import house_case, success
from specshield.policy.tensors import replace_file
from specshield.shipped import MODELS
from specshield.sim.cases import case_names, load_case
from specshield.sim.learned.model import CARD, FOLDER, WEIGHTS, LearnedModel, read, target_of
from specshield.sim.learned.network import KINDS, TEMPERATURE
from specshield.sim.progress import StatusLine, duration

RUNS = 200  # a measurement
ABOUT = (
    "A causal transformer that imitates shortest paths (sim/learned); no pose, map, rule or region. "
    "It remembers where it was by counting its own actions. "
)
INTERFERENCE = {
    True: "In half of its training it was held or steered. ",
    False: "It was never held or steered. ",
}
WITHOUT_CASES = "Trained on generated apartments alone; the cases' apartments were never seen."
WITH_CASES = "Trained on generated apartments and on those of the cases."


def train_model(
    seed: int, out: Path, options: Mapping[str, float], with_cases: bool = False, start: Path | None = None
) -> int:
    """Writes the weights and a card with what was measured to `out`; the exit status.

    options: settings of train.py. with_cases: whether it also practises in the apartments of the cases.
    start: a folder with a model to go on from. Raises NotFound, PolicyError.
    """
    from evaluation.model.train import Report, Settings, train  # torch
    from evaluation.model.transformer import export, restore

    settings = Settings(**options)  # type: ignore[arg-type]
    before = None if start is None else read(start)
    status, began = StatusLine(), time.monotonic()

    def show(report: Report) -> None:
        done = report.round + 1
        left = (time.monotonic() - began) / done * (settings.rounds - done)
        status.say(f"round {done} of {settings.rounds}, loss {report.loss:.3f}, {duration(left)} left")

    cases = [load_case(name) for name in case_names()] if with_cases else []
    practised = [
        House(
            case.task.grid,
            tuple(APARTMENTS[case.name].rooms.values()),
            tuple(APARTMENTS[case.name].rooms),
            {target_of(case.instruction): case.target},
        )
        for case in cases
    ]
    begun = None if before is None else restore(before.weights)
    weights = export(train(settings, seed, practised, show, begun))
    wall = time.monotonic() - began
    status.say("measuring ...")
    metrics = measure(weights, TEMPERATURE) | {"wall_time_s": round(wall, 1)}
    card = {
        "format": 1,
        "about": ABOUT + INTERFERENCE[settings.interference] + (WITH_CASES if with_cases else WITHOUT_CASES),
        "temperature": TEMPERATURE,
        "kinds": list(KINDS),
        "options": settings.to_json() | {"with_cases": with_cases},
        "seed": seed,
        "metrics": metrics,
        "started_from": None if before is None else before.card,
    }
    status.clear()
    write(out, weights, card)
    for name, figures in metrics.items():
        print(name, figures)
    return 0


def measure(weights: dict[str, Any], temperature: float) -> dict[str, Any]:
    """How many of RUNS unshielded runs find their target: in each case, and in apartments never seen."""
    figures: dict[str, Any] = {}
    for name in case_names():
        case = load_case(name)
        model = LearnedModel(weights, target_of(case.instruction), temperature)
        figures[name] = success([(case, model)] * RUNS, seed=0)
    random, runs = np.random.default_rng([2**31, 0]), []
    for _ in range(RUNS):
        house = random_house(random)
        kind = str(random.choice(sorted(house.targets)))
        runs.append((house_case(house, kind), LearnedModel(weights, kind, temperature)))
    return figures | {"unseen_apartments": success(runs, seed=0)}


def write(out: Path, weights: dict[str, Any], card: dict[str, Any]) -> None:
    from safetensors.numpy import save

    out.mkdir(parents=True, exist_ok=True)
    replace_file(out / WEIGHTS, save(weights))
    (out / CARD).write_text(json.dumps(card, indent=1) + "\n")


def main() -> None:
    parser = argparse.ArgumentParser(description="Train the learned foundation model.")
    parser.add_argument("--seed", type=int, default=0, help="decides everything random")
    parser.add_argument("--option", action="append", default=[], help="a setting, as rounds=100; repeatable")
    parser.add_argument("--start", type=Path, help="folder with a model to go on from")
    parser.add_argument("--with-cases", action="store_true", help="practise in the cases' apartments too")
    parser.add_argument("--out", type=Path, default=MODELS / FOLDER, help="folder to write to")
    chosen = parser.parse_args()
    options = {name: json.loads(value) for name, _, value in (text.partition("=") for text in chosen.option)}
    raise SystemExit(train_model(chosen.seed, chosen.out, options, chosen.with_cases, chosen.start))


if __name__ == "__main__":
    main()
