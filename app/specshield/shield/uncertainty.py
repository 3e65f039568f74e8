"""How far the robot's motions differ from f, and the margin and the slack that follow from it.

A motion is taken to differ from f in two ways, whatever was before it:

    noise   it ends off by a normal deviate along x and along y [m], and in heading [rad]
    slip    it is not executed, with some probability

What was said or is assumed of them before the first step is weighed against the motions that are seen
(caution/experience.py). docs/uncertainty.md says what the margin and the slack promise, and on what terms.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from specshield.arrays import Floats
from specshield.compiled import leaf
from specshield.errors import InputError

MOST_TRANSLATION = 10.0  # [m] a motion that is less certain than this is none. Chosen by hand.
CHANCE = 0.01  # that margin and slack do not suffice in an episode: half of it for each. Chosen by hand.
MENDED = 0.1  # [rad] a heading off by this costs a motion to mend; a Stretch's smallest turn is 6 degrees
HARDER = 2.0  # times the noise itself: what it costs in motions (docs/uncertainty.md)


@dataclass(frozen=True)
class Uncertainty:
    """How far one motion may lead from where f foresees it.

    translation: standard deviation of the position after a motion, along each axis [m]. rotation: of the
    heading [rad]. slip: the probability that a motion is not executed at all. The defaults are what is taken
    of a robot of which nothing is known: the noise that the makers of SPOC define for a Stretch, and a slip
    of 5 %.

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


class Noise(NamedTuple):
    """What motions are taken to do from here on.

    move [m] and turn [rad]: standard deviations. slips: the probability that motions slip at all; if they do,
    the share that does has the density Beta(lost, kept).
    """

    move: float
    turn: float
    slips: float
    lost: float
    kept: float


EXACT = Noise(0.0, 0.0, 0.0, 1.0, 1.0)


class Care(NamedTuple):
    """What J asks for beyond satisfaction at one step.

    margin [m]; least [steps]: the slack of every deadline. noise: because of which more of it is asked for.
    stride: the robot's longest move [m]. chance: that the slack of one deadline does not suffice. barred
    [n, 6]: what no future goes by where another keeps the rule (robot/barred.py); None where nothing is.
    on_way: whether the robot is where the last answer had it, on a way that keeps what was asked for then.
    room: whether to go where a larger robot could too, where another future with room keeps the rule.
    guess: whether the map is one of several that one decision tries.
    """

    margin: float
    least: int
    noise: Noise = EXACT
    stride: float = 1.0
    chance: float = CHANCE
    barred: Floats | None = None
    on_way: bool = False
    room: bool = False
    guess: bool = False

    @property
    def has_slack(self) -> bool:
        return self.least > 0 or self.noise is not EXACT


def margin_for(noise: Noise, stride: float, steps: int) -> float:
    """The margin [m] that none of `steps` motions oversteps, but for CHANCE / 2.

    A deviation has two normal coordinates, and a heading that is off moves the end of the next stride too. It
    is longer than r with the probability exp(-r^2 / 2 sigma^2); the chances of the steps are added up.
    """
    sigma = math.hypot(noise.move, stride * noise.turn)
    return sigma * math.sqrt(2.0 * math.log(2.0 * max(steps, 1) / CHANCE))


@leaf
def slack_for(noise: Noise, stride: float, left: int, chance: float, least: int) -> int:
    """The fewest steps to keep free of `left` ones, `least` or more, so that these cost more of them but for
    `chance`.
    """
    for free in range(least, left):
        if costs_above(noise, stride, left, free) <= chance:
            return free
    return max(left, least)


@leaf
def spread_of(noise: Noise, stride: float) -> float:
    """The standard deviation of what noise costs in one motion [motions]."""
    return HARDER * math.hypot(noise.move / stride, noise.turn / MENDED)


@leaf
def costs_above(noise: Noise, stride: float, n: int, free: int) -> float:
    """The probability that n motions cost more than `free` steps beside their own.

    A beta-binomial number of them is not executed; what noise costs is taken to be normal, of a standard
    deviation that grows with the root of n.
    """
    sigma = spread_of(noise, stride) * math.sqrt(n)
    if sigma <= 0.0 and free >= n:
        return 0.0
    over = (1.0 - noise.slips) * above(free, sigma)
    if noise.slips <= 0.0:
        return over
    lost, kept = noise.lost, noise.kept
    share = 1.0  # the probability that none is lost; logarithms of Gamma are too coarse for large counts
    for i in range(n):
        share *= (kept + i) / (lost + kept + i)
    rest = 1.0  # the probability that more motions are lost than were counted
    for k in range(min(free + int(4.0 * sigma), n) + 1):
        over += noise.slips * share * above(free - k, sigma)
        rest -= share
        if k < n:
            share *= (n - k) / (k + 1.0) * (lost + k) / max(kept + n - k - 1.0, 1e-9)
    return over + noise.slips * max(rest, 0.0)


@leaf
def above(value: float, sigma: float) -> float:
    """The probability that a normal deviate of standard deviation `sigma` is above a value."""
    if sigma <= 0.0:
        return 1.0 if value < 0.0 else 0.0
    return 0.5 * math.erfc(value / (sigma * math.sqrt(2.0)))
