"""How far the robot's motions differ from f, and the margin and the slack that follow from it.

Each motion is taken to differ from f in two ways, independently of the motions before it:

    noise   it ends off by a normal deviate along x, along y [m], and in heading [rad]
    slip    it is not executed, with some probability

What was said or is assumed of both before the first step is weighed against the motions that are seen
(caution/experience.py). docs/uncertainty.md says what the margin and the slack promise, and on what terms.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from specshield.arrays import Floats
from specshield.compiled import leaf

# The accepted probability that margin or slack does not suffice in an episode; each gets half. By hand.
CHANCE = 0.01
MENDED = 0.1  # [rad] a heading that is off by this costs one motion; a Stretch's smallest turn is 6 degrees
HARDER = 2.0  # noise costs this many times as many motions as its size says (docs/uncertainty.md)


class Noise(NamedTuple):
    """How motions are taken to differ from f from now on.

    move [m], turn [rad]: standard deviations. slips: the probability that motions slip at all. If they do,
    the share of them that slips has the density Beta(lost, kept).
    """

    move: float
    turn: float
    slips: float
    lost: float
    kept: float


EXACT = Noise(0.0, 0.0, 0.0, 1.0, 1.0)


class Care(NamedTuple):
    """What J asks for beyond satisfaction at one step.

    margin [m]; least [steps]: the slack that every deadline gets at least. noise: may ask for more slack.
    stride: the robot's longest move [m]. chance: the accepted probability that the slack of one deadline does
    not suffice. barred [n, 6]: motions that futures avoid as long as one without them keeps the rule
    (surprise/barred.py); None if there are none. on_way: whether the robot is where the last answer foresaw
    it, on a way that keeps what was asked for then. room: whether futures on which a larger robot would have
    room are preferred. guess: whether the map is one of several that one decision tries.
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


def margin_for(noise: Noise, stride: float, steps: int) -> float:
    """The margin [m] that is exceeded by none of `steps` motions, with a probability of 1 - CHANCE / 2.

    A deviation has two normal coordinates; a wrong heading moves the end of the next stride too. The
    deviation is longer than r with probability exp(-r^2 / 2 sigma^2). These probabilities are added up over
    the steps.
    """
    sigma = math.hypot(noise.move, stride * noise.turn)
    return sigma * math.sqrt(2.0 * math.log(2.0 * max(steps, 1) / CHANCE))


@leaf
def slack_for(noise: Noise, stride: float, left: int, chance: float, least: int) -> int:
    """The least slack, `least` or more, for a deadline in `left` steps: the motions that remain cost more
    extra steps than that with a probability of at most `chance`.
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
    """The probability that n motions cost more than `free` steps beside their own n.

    The number of motions that are not executed is beta-binomial. The steps that noise costs are taken to be
    normal, with a standard deviation that grows with the square root of n.
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
