"""What a caller says of how far its robot's motions differ from f."""

from __future__ import annotations

import math
from dataclasses import dataclass

from specshield.errors import InputError

MOST_TRANSLATION = 10.0  # [m] the largest standard deviation that a caller may declare. Chosen by hand.


@dataclass(frozen=True)
class Uncertainty:
    """How far one motion may lead from where f foresees it.

    translation: standard deviation of the position after a motion, along each axis [m]. rotation: of the
    heading [rad]. slip: the probability that a motion is not executed at all. The defaults are assumed of a
    robot of which nothing is known: the noise that the makers of SPOC define for a Stretch, and a slip of
    5 %.

    Raises InputError with the field's path for numbers out of range.
    """

    translation: float = 0.01
    rotation: float = math.radians(0.5)
    slip: float = 0.05

    def __post_init__(self) -> None:
        most = {"translation": MOST_TRANSLATION, "rotation": math.pi, "slip": 1.0}
        for name, highest in most.items():
            value = getattr(self, name)
            if not (math.isfinite(value) and 0.0 <= value <= highest):
                told, expected = f"the {name} of the uncertainty is out of range", f"from 0 to {highest:g}"
                raise InputError(told, path=f"uncertainty.{name}", got=value, expected=expected)
