"""The models that campaigns are run with, by name."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from evaluation.models import bot, courteous, errant, follower, rover
from specshield.errors import NotFound
from specshield.shipped import MODELS as FOLDERS
from specshield.sim import model, robot, senses
from specshield.sim.cases import Case
from specshield.sim.learned import model as learned
from specshield.sim.learned import network, reckoning
from specshield.sim.model import FoundationModel, GoalSeeker

UNSTEERED = "fm-unsteered"  # in models/, beside the network that was trained with interference


@dataclass(frozen=True)
class Named:
    """A model that campaigns can be run with.

    make: the model, told the case's instruction. code: the files of the modules that decide what it does.
    folder: of its weights in models/, where it has any.
    """

    make: Callable[[Case], FoundationModel]
    code: tuple[str, ...]
    folder: str | None = None

    @property
    def code_hash(self) -> str:
        """The sha256 of those files: records made by other code do not go with records made by this one."""
        return hashlib.sha256(b"".join(Path(file).read_bytes() for file in self.code)).hexdigest()


def _learned(folder: str) -> Named:
    code = tuple(str(module.__file__) for module in (learned, network, reckoning, robot, senses))
    return Named(lambda case: learned.load_learned(case.instruction, FOLDERS / folder), code, folder)


SENSING = (str(robot.__file__), str(senses.__file__))
SEEKER = (str(model.__file__), str(robot.__file__))
ERRANT = (*SEEKER, str(errant.__file__))
MODELS = {
    "bot": Named(bot.Bot, (*SENSING, str(bot.__file__))),
    "decoyed": Named(errant.Decoyed, ERRANT),
    "drifter": Named(lambda case: errant.Drifter(case.task.robot), ERRANT),
    "goal-seeker": Named(lambda case: GoalSeeker(case.task.robot), SEEKER),
    "jumper": Named(errant.Jumper, ERRANT),
    "learned": _learned(learned.FOLDER),
    "rover": Named(lambda case: rover.Rover(case.task.robot), (*SENSING, str(rover.__file__))),
    "unsteered": _learned(UNSTEERED),
}
TELLING = {  # what they show is measured by habits.py, in tables of its own
    "courteous": Named(courteous.Courteous, (*SEEKER, str(bot.__file__), str(courteous.__file__))),
    "follower": Named(follower.Follower, (*SEEKER, *SENSING, str(rover.__file__), str(follower.__file__))),
}


def named(name: str) -> Named:
    """The model of that name. Raises NotFound."""
    there = MODELS | TELLING
    if name not in there:
        raise NotFound(
            f"there is no model {name!r}", path="model", got=name, expected=f"one of {', '.join(there)}"
        )
    return there[name]
