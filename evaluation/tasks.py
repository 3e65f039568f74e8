"""Main tasks that can be lost: a case's name with a suffix is that case with a harder task for the model.

    case1-two        two things to find, one after the other
    case1-200        200 steps, in place of MAX_STEPS
    case1-two-300    both

The rule and the map stay what they are.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, replace

from evaluation.models.order import InOrder
from specshield.errors import InputError
from specshield.sim.cases import Case
from specshield.sim.model import FoundationModel
from specshield.sim.robot import SimulatedRobot

MAX_STEPS = 600
NAME = re.compile(r"(?P<base>.+?)(?P<two>-two)?(-(?P<limit>\d+))?")
SECOND = {"case1": ("pillow", (2.8, 8.1)), "case2": ("pillow", (2.6, 8.6))}
"""What is to be found after the map's own target, and where it is [m]: beside the bed."""


@dataclass(frozen=True)
class MainTask:
    """base: the name of the case without suffix. two: whether two things are to be found. limit: in how many
    steps. Raises InputError.
    """

    base: str
    two: bool = False
    limit: int = MAX_STEPS

    def __post_init__(self) -> None:
        if self.two and self.base not in SECOND:
            raise InputError(
                "there is no second thing to find", path="case", got=f"{self.base}-two",
                expected=f"-two after one of {', '.join(SECOND)}",
            )  # fmt: skip
        if not 1 <= self.limit <= MAX_STEPS:
            raise InputError(
                "not a limit of steps", path="case", got=self.limit, expected=f"from 1 to {MAX_STEPS}"
            )

    def of(self, case: Case, suffix: str) -> Case:
        """The case with this task; its target is the last thing to find."""
        last = self._stages(case)[-1]
        said = case.instruction + (f", then a {SECOND[self.base][0]}" if self.two else "")
        return replace(last, name=case.name + suffix, instruction=said) if suffix else case

    def model(self, make: Callable[[Case], FoundationModel], case: Case) -> FoundationModel:
        """case: as it was before `of`."""
        stages = self._stages(case)
        return InOrder(make, stages) if self.two else make(case)

    def _stages(self, case: Case) -> list[Case]:
        if not self.two:
            return [case]
        thing, place = SECOND[self.base]
        return [case, replace(case, instruction=f"find a {thing}", target=place)]


def main_task(name: str) -> MainTask:
    """What the name of a case says. Raises InputError."""
    said = NAME.fullmatch(name)
    assert said is not None  # any text that is not empty has a base
    return MainTask(said["base"], said["two"] is not None, int(said["limit"] or MAX_STEPS))


def is_done(model: FoundationModel, robot: SimulatedRobot) -> bool:
    """Whether the model has done its task if it ends where it is."""
    before = model.found if isinstance(model, InOrder) else [True]
    return robot.at_target and len(before) > 0 and all(before)
