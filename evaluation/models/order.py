"""A model that has to find things in order, made of models that have to find one thing each.

Each says `end` where it believes to have found its thing. Before the last thing the token `sub_done` takes
the place of `end`: where it was meant and is executed, the next model takes over, with an empty memory.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from specshield.arrays import Floats
from specshield.robot import STRETCH
from specshield.sim.cases import Case
from specshield.sim.model import FoundationModel, softmax
from specshield.sim.robot import SimulatedRobot

SUB_DONE = STRETCH.action_names.index("sub_done")
END = STRETCH.action_names.index("end")
MEANT = 0.1  # probability from which on an executed `sub_done` was the model's; without, it was told to wait


class InOrder:
    """found: for each thing that it took for found, whether it was within 1 m of it."""

    def __init__(self, make: Callable[[Case], FoundationModel], stages: Sequence[Case]) -> None:
        """stages: the case with each thing as its target, told to find that one alone."""
        self._stages = [(case, make(case)) for case in stages]
        self.reset(np.random.default_rng(0))

    def reset(self, random: np.random.Generator) -> None:
        for (_, model), own in zip(self._stages, random.spawn(len(self._stages)), strict=True):
            model.reset(own)
        self.found: list[bool] = []
        self._meant = False

    def logits(self, robot: SimulatedRobot) -> Floats:
        last: int | None = robot.last_action
        if self._meant and last == SUB_DONE:
            case, _ = self._stages[len(self.found)]
            self.found.append(SimulatedRobot(case, robot.pose).at_target)
            last = None
        case, model = self._stages[len(self.found)]
        seen = SimulatedRobot(case, robot.pose)
        seen.last_action = last
        logits, self._meant = model.logits(seen).copy(), False
        if len(self.found) + 1 < len(self._stages):
            logits[SUB_DONE], logits[END] = logits[END], logits.min()
            self._meant = bool(softmax(logits)[SUB_DONE] > MEANT)
        return logits
