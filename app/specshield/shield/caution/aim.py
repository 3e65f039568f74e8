"""What J asks for beyond satisfaction, so that noise does not break the rule: a margin [m] and slack [steps].

The margin is asked of the whole trajectory first. Where no future keeps it there, or where slack is asked for
too, it is asked of what the formula still leaves open. Where both cannot be had, the slack is lowered first,
to the most steps with which the margin can be had, or with which as much of it can be had as without slack;
and then raised again as far as can be, one deadline after the other.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from specshield.arrays import Bools, Floats, Ints
from specshield.compiled import kernel
from specshield.rule.early import Conjuncts, conjunction_of, find_open, rate_open
from specshield.shield.decision import Shield
from specshield.shield.feasibility import Best, Futures, Prefix, best_rows, rho_of
from specshield.shield.uncertainty import Care, Noise, slack_for
from specshield.stl import SATISFIED_ABOVE
from specshield.stl.tree import EVENTUALLY

NEVER = 1 << 40  # in place of a number of steps


class Aimed(NamedTuple):
    """best: the best future of each motion. kept [M]: those that keep as much as can be had of what is asked.

    margin [m], slack [steps]: how much that is, the slack at the next deadline. lowered: whether it is less
    than the session's settings ask for; what is asked for beside them is had where it can be. early (K,)
    [steps]: of each conjunct.
    """

    best: Best
    kept: Bools
    margin: float
    slack: int
    lowered: bool
    early: Ints = np.zeros(0, np.int64)


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
    view, parts = conjunction_of(task, prefix.formula)
    if view is not None:
        prefix = prefix.of(prefix.formula, view)
        _, leaves = rho_of(prefix, tried.poses)
    count, motions = len(parts.kind), len(task.robot.motions)
    now = Open._make((parts, np.empty(count, np.bool_), *np.zeros((2, count), np.int64), prefix.t))
    _ask(now, prefix.known, care.noise, care.stride, care.least, care.chance)

    def at(early: Ints) -> tuple[Best, bool]:
        rows, robustness = np.empty(motions, np.int64), np.empty(motions)
        highest = _best_open(now, early, leaves, whole, tried.motions, follows, margin, rows, robustness)
        return Best(robustness, rows), highest > margin

    if before is not None:
        margin = min(margin, SATISFIED_ABOVE + before.margin)
        best, _ = at(before.early)
        return before._replace(best=best, kept=best.robustness > margin)
    early = now.asked
    best, had = at(early)
    if not had:
        early = np.zeros(count, np.int64)
        best, had = at(early)
        if not had:  # nor the margin: ask for all that can be had of it, and for slack beside that
            margin = max(float(np.nextafter(best.robustness.max(), -np.inf)), SATISFIED_ABOVE)
        for of in (early == 0, *(np.arange(count) == k for k in np.argsort(now.due, kind="stable"))):
            low, high = int(early[of].max()), int(now.asked[of].max()) + 1
            while high - low > 1:
                middle = (low + high) // 2
                more = np.where(of, np.minimum(now.asked, middle), early)
                tighter, had = at(more)
                best, early = (tighter, more) if had else (best, early)
                low, high = (middle, high) if had else (low, middle)
    margin_had, slack = margin - SATISFIED_ABOVE, int(early[np.argmin(now.due)])
    less = (early < np.minimum(now.asked, shield.config.slack)).any()
    lowered = bool(less or margin_had < shield.config.margin)
    return Aimed(best, best.robustness > margin, margin_had, slack, lowered, early)


class Open(NamedTuple):
    """The conjuncts at step t: which are still open (K,), how early each is asked for (K,), and in how many
    steps it is due (K,), NEVER where it is not.
    """

    parts: Conjuncts
    still: Bools
    asked: Ints
    due: Ints
    t: int


@kernel
def _ask(now: Open, known: Floats, noise: Noise, stride: float, least: int, chance: float) -> None:
    """Fills in `still`, `asked` and `due` of `now`, whose `asked` is 0. A window keeps half its length."""
    parts, still, asked, due, t = now
    find_open(parts, known, t, still)
    for k in range(still.shape[0]):
        half, due[k] = max(parts.half[k], parts.lead[k] if parts.a[k] > t else 0), NEVER
        if still[k] and half > 0:
            left = parts.b[k] + parts.horizon[k] - t
            if parts.kind[k] != EVENTUALLY:  # the first that its child is asked for
                left = min(left, max(parts.a[k] - t, 1) + parts.horizon[k])
            asked[k] = half if least >= half else min(slack_for(noise, stride, left, chance, least), half)
            due[k] = left


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
    rho = np.empty(whole.shape[0])
    rate_open(now.parts, now.still, now.t, early, leaves, rho)
    rho[~(whole > SATISFIED_ABOVE)] = -np.inf
    best_rows(motions, rho, rows, robustness)
    if follows and rho[0] > margin:
        rows[motions[0, 0]] = 0
    return float(robustness.max())
