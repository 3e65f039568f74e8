"""A package that adds a method which learns nothing, for as long as it is told to. It needs no module that
takes long to import: what a server does with any run that learns can be tested without waiting for torch.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

from specshield.policy.methods import Method, Run, lazily
from specshield.policy.options import option


@dataclass(frozen=True)
class Options:
    steps: int = option(1, "How many steps of 20 ms it takes.", low=1, high=1_000_000)


def check(task: Any, options: Options) -> None:
    """Any task will do."""


def make(task: Any, options: Options, run: Run) -> Any:
    for step in range(options.steps):
        run.on_progress(step / options.steps, 0.02 * (options.steps - step), "patient")
        time.sleep(0.02)
    return lazily("specshield.policy.reachability.policy:synthesise")(task)


LOAD = lazily("specshield.policy.reachability.policy:load_reachability")
METHOD = Method("Learns nothing, patiently.", Options, check, make, LOAD, needs=("specshield",))
