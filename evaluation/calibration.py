"""Measured margins: the method NAME@conformal/K becomes NAME@M/K, with M metres from a calibration."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

from evaluation.conformal import conformal_margin
from evaluation.evaluation import evaluate
from evaluation.experiment import Experiment
from specshield.errors import InputError
from specshield.policy.tensors import replace_file

FILE = "calibration.json"
RUNS = 60  # of a calibration campaign; ALPHA asks for 19 at least
ALPHA = 0.05  # share of the episodes that may hold a surprise larger than the margin
JUDGED = "ours"
OTHER_SEED = 1_000_003  # added to the seed: no calibration run is a run of the experiment


def calibrated(experiment: Experiment, method: str, folder: Path | None, processes: int) -> str:
    """The method with its margin as a number, rounded up to millimetres; other methods as they are.

    The calibration campaign is the same experiment with another seed, run by JUDGED without a margin. All
    methods of the experiment that ask for the same slack are given what it found, so that none has the better
    margin. It is kept in `folder`, if one is given, as FILE.
    """
    kind, _, asked = method.partition("@conformal")
    if kind == method:
        return method
    found = {} if folder is None else kept_in(folder)
    name = f"conformal{asked}"
    if name not in found:
        others = replace(experiment, seed=experiment.seed + OTHER_SEED)
        scores = [r.residual for r in evaluate(others, RUNS, [f"{JUDGED}@0{asked}"], None, processes)]
        margin = conformal_margin(scores, ALPHA)
        found[name] = {
            "asked": asked,
            "margin": margin,
            "rounded": math.ceil(1e3 * margin) / 1e3,
            "alpha": ALPHA,
            "runs": RUNS,
            "seed": others.seed,
        }
        if folder is not None:
            folder.mkdir(parents=True, exist_ok=True)
            replace_file(folder / FILE, (json.dumps(found, indent=1) + "\n").encode())
    return f"{kind}@{found[name]['rounded']:g}{asked}"


def kept_in(folder: Path) -> dict[str, dict[str, Any]]:
    """The calibrations that a folder holds, by what was asked for, as "conformal/4". Raises InputError for a
    file that holds something else.
    """
    path = folder / FILE
    if not path.exists():
        return {}
    try:
        found: dict[str, dict[str, Any]] = json.loads(path.read_bytes())
        for made in found.values():
            numbers = made["margin"], made["rounded"], made["runs"]
            if not (isinstance(made["asked"], str) and all(type(each) in (int, float) for each in numbers)):
                raise TypeError
        return found
    except (ValueError, KeyError, TypeError, AttributeError):
        raise InputError(
            f"{path} is no calibration", path="out", got=str(folder),
            expected="what `evaluate` wrote there; or delete the file, and `evaluate` calibrates anew",
        ) from None  # fmt: skip
