"""What J asks for beyond satisfaction, so that noise does not break the rule: a margin [m] and slack [steps].

The margin is asked of the whole trajectory first. Where no future keeps it there, or where slack is asked for
too, it is asked of what the formula still leaves open. Where both cannot be had, the slack is lowered first,
to the most steps with which the margin can be had, or with which as much of it can be had as without slack;
and then that of the next deadline is raised again as far as can be.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from specshield.arrays import Bools, Floats, Ints
from specshield.compiled import kernel
from specshield.rule.early import Conjuncts, conjunction_of, find_open, rate_open
from specshield.shield.decision import Shield
from specshield.shield.feasibility import Best, Futures, Prefix, rho_of
from specshield.shield.uncertainty import Care, Noise, slack_for
from specshield.stl import SATISFIED_ABOVE
from specshield.stl.tree import ALWAYS, EVENTUALLY


class Aimed(NamedTuple):
    """best: the best future of each motion. kept [M]: those that keep as much as can be had of what is asked.

    margin [m], slack [steps]: how much that is, the slack at the next deadline. lowered: whether it is less
    than the session's settings ask for; what is asked for beside them is had where it can be. most [steps]:
    no other deadline is asked for more steps early than that.
    """

    best: Best
    kept: Bools
    margin: float
    slack: int
    lowered: bool
    most: int = 0


def aim(
    shield: Shield,
    care: Care,
    prefix: Prefix,
    tried: Futures,
    whole: Floats,
    leaves: Floats,
    follows: bool,
    before: Aimed | None = None,
) -> Aimed:
    """The most that can be had of the margin and the slack.

    whole [N], leaves [N, size]: rho of the futures on the whole of `prefix.formula`, and its leaves. A future
    that does not satisfy it counts for nothing, whatever it keeps of a part. follows: whether the first
    future is what is left of the way that the robot is on. before: what could be had of fewer futures, of
    which no more is asked.
    """
    task, margin = shield.task, SATISFIED_ABOVE + care.margin
    own = prefix.formula is task.formula
    formula, parts = shield.conjunction if own else conjunction_of(task, prefix.formula)
    if formula is not prefix.formula:  # it is written as a plain conjunction, and may have other leaves
        prefix = prefix.of(formula)
        _, leaves = rho_of(prefix, tried)
    still = Open(parts, np.empty(len(parts.kind), np.bool_), np.zeros(len(parts.kind), np.int64), prefix.t)
    soonest, high = _ask(still, prefix.known, care.noise, care.stride, care.least, care.chance)
    next_due = int(still.asked[soonest]) if soonest >= 0 else 0

    def at(most: int, first: int) -> tuple[Best, bool]:
        early, rows, robustness = (
            np.minimum(still.asked, most),
            np.empty(motions, np.int64),
            np.empty(motions),
        )
        if soonest >= 0:
            early[soonest] = min(first, next_due)
        highest = _best_open(still, early, leaves, whole, tried.motions, follows, margin, rows, robustness)
        return Best(robustness, rows), highest > margin

    def most_had(best: Best, low: int, high: int, most: int | None = None) -> tuple[Best, int]:
        while high - low > 1:
            middle = (low + high) // 2
            tighter, had = at(middle if most is None else most, middle)
            best, low, high = (tighter, middle, high) if had else (best, low, middle)
        return best, low

    motions = len(task.robot.motions)
    if before is not None:
        margin = min(margin, SATISFIED_ABOVE + before.margin)
        best, _ = at(before.most, before.slack)
        return before._replace(best=best, kept=best.robustness > margin)
    best, had = at(high, high)
    if had:
        return Aimed(best, best.robustness > margin, care.margin, next_due, False, high)
    best, had = at(0, 0)  # slack `high` cannot be had
    if not had:  # nor the margin: ask for all that can be had of it, and for slack beside that
        margin, high = max(float(np.nextafter(best.robustness.max(), -np.inf)), SATISFIED_ABOVE), high + 1
    best, low = most_had(best, 0, high)
    best, first = most_had(best, min(low, next_due), next_due + 1, low)
    margin_had = margin - SATISFIED_ABOVE
    lowered = low < shield.config.slack or margin_had < shield.config.margin
    return Aimed(best, best.robustness > margin, margin_had, first, lowered, low)


class Open(NamedTuple):
    """The conjuncts at step t: which are still open (K,), and how early each F is asked for (K,) [steps]."""

    parts: Conjuncts
    still: Bools
    asked: Ints
    t: int


@kernel
def _ask(now: Open, known: Floats, noise: Noise, stride: float, least: int, chance: float) -> tuple[int, int]:
    """Fills `now`, whose `asked` is 0. The conjunct whose deadline is next, -1 for none, and the most steps
    that any is asked for. A window keeps at least half its length.
    """
    parts, still, asked, t = now
    find_open(parts, known, t, still)
    soonest, first = -1, 0
    for k in range(still.shape[0]):
        half, begun = parts.half[k], parts.plain[k] and parts.kind[k] == ALWAYS and parts.a[k] <= t
        if still[k] and half > 0 and not begun:
            left = parts.b[k] + parts.horizon[k] - t
            if parts.kind[k] != EVENTUALLY:  # the first that its child is asked for
                left = min(left, max(parts.a[k] - t, 1) + parts.horizon[k])
            asked[k] = half if least >= half else min(slack_for(noise, stride, left, chance, least), half)
            if soonest < 0 or left < first:
                soonest, first = k, left
    return soonest, (asked.max() if asked.size else 0)


@kernel
def _best_open(
    now: Open,
    early: Ints,
    leaves: Floats,
    whole: Floats,
    motions: Ints,
    follows: bool,
    margin: float,
    rows: Ints,
    robustness: Floats,
) -> float:
    """Writes the best future of each motion by what is open, and its robustness; the highest of them.

    The way that the robot is on stays its motion's future (`rows`) where it keeps enough, though another may
    be more robust: a robot that changes to a better one at each step may go to and fro and never arrive.
    """
    rho, stays = np.empty(whole.shape[0]), -1
    rate_open(now.parts, now.still, now.t, early, leaves, rho)
    rows[:] = -1
    robustness[:] = -np.inf
    for f in range(whole.shape[0]):
        m = motions[f, 0]
        value = rho[f] if whole[f] > SATISFIED_ABOVE else -np.inf
        if follows and f == 0 and value > margin:
            stays = m
        if rows[m] < 0 or value > robustness[m]:
            robustness[m] = value
            rows[m] = 0 if m == stays else f
    return float(robustness.max())
