"""What J asks for beyond satisfaction, so that noise does not break the rule: a margin [m] and slack [steps].

The margin is asked of the whole trajectory first. If no future has it there, or if slack is asked for too, it
is asked only of those parts of the formula that are still open. If no future has both, the slack is lowered
first: to the most steps that leave the margin, or leave as much of the margin as can be had without slack.
Then it is raised again as far as possible, one deadline after the other.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from specshield.arrays import Bools, Floats, Ints
from specshield.caution.early import Conjuncts, conjunction_of, find_open, rate_open
from specshield.caution.noise import Care, Noise, slack_for
from specshield.compiled import Boxed, kernel
from specshield.shield.decision import Shield
from specshield.shield.feasibility import Best, Futures, Prefix, best_of, rho_of
from specshield.stl import SATISFIED_ABOVE
from specshield.stl.tree import ALWAYS, EVENTUALLY

NEVER = 1 << 40  # in place of a number of steps


class Aimed(NamedTuple):
    """As much of the margin and the slack as some future has.

    best: the best future of each motion. kept [M]: the motions whose best future has that much. margin [m];
    slack [steps]: that of the next deadline. lowered: whether either is less than the session's settings ask
    for; more than these may be asked for because of noise. early (K,) [steps]: the slack of each conjunct.
    visits (K,): the robustness above which visits in the past count for a conjunct.
    """

    best: Best
    kept: Bools
    margin: float
    slack: int
    lowered: bool
    early: Ints = np.zeros(0, np.int64)
    visits: Floats = np.zeros(0)


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
    """The most of the margin and the slack that some future has.

    whole [N], leaves [N, size]: rho of `prefix.formula` along each future, and its leaves. A future that does
    not satisfy the whole formula does not count, whatever parts it keeps. follows: whether the first future
    is what is left of the way that the robot is on. before: the result for fewer futures; the margin and the
    slack found then are asked of all futures now, and no more.
    """
    view, parts = conjunction_of(shield.task, prefix.formula)
    if view is not None:
        prefix = prefix.of(prefix.formula, view)
        _, leaves = rho_of(prefix, tried.poses)
    size, count = len(parts.value.kind), len(shield.task.robot.motions)
    still, short, settled = np.empty(size, np.bool_), np.empty(size, np.bool_), np.empty(size)
    asked, due = np.empty(size, np.int64), np.empty(size, np.int64)
    arrays = still, settled, asked, due, prefix.t, short, prefix.known, leaves, whole, tried.motions
    now = Open(*arrays, count, follows)
    if before is not None:
        find_open(parts, prefix.known, prefix.t, before.visits, still, settled)
        margin = min(care.margin, before.margin) + SATISFIED_ABOVE
        best, _ = _best_open(parts, now, before.early, margin)
        return before._replace(best=best, kept=best.robustness > margin)
    any_visit = np.array([SATISFIED_ABOVE] * size)  # numpy is slow for so few
    aimed = _aim(shield, care, parts, now, any_visit, np.zeros(size, np.int64))
    if True not in short.tolist():
        return aimed
    # Places that were visited with less than the margin are visited again, all of them or else each of which
    # that is possible with no less margin, and with half of the slack for all that is open beside it.
    places, half, robust = short.copy(), asked // 2, any_visit + care.margin
    for some in (places, *np.eye(size, dtype=np.bool_)[places]):
        tighter = _aim(shield, care, parts, now, np.where(some, robust, aimed.visits), half)
        if tighter.margin >= aimed.margin and tighter.kept.any():
            aimed = tighter
            if some is places:
                break
    return aimed


def _aim(
    shield: Shield, care: Care, parts: Boxed[Conjuncts], now: Open, visits: Floats, sooner: Ints
) -> Aimed:
    """`aim`, where a past visit counts if its robustness was above its conjunct's entry of `visits` (K,), and
    the slack is not lowered below `sooner` (K,).
    """
    margin, asking = SATISFIED_ABOVE + care.margin, (care.noise, care.stride, care.least, care.chance)
    best, had = _best_asked(parts, now, asking, visits, margin)
    early = now.asked.copy()
    if not had:
        best, had = _best_open(parts, now, early := sooner, margin)
        if not had:  # there is no such margin either: ask for the largest that there is, and then for slack
            margin = max(float(np.nextafter(best.robustness.max(), -np.inf)), SATISFIED_ABOVE)
        for of in (early >= 0, *(np.arange(len(early)) == k for k in np.argsort(now.due, kind="stable"))):
            low, high = int(early[of].min()), int(now.asked[of].max()) + 1
            while high - low > 1:
                middle = (low + high) // 2
                more = np.where(of, np.maximum(np.minimum(now.asked, middle), early), early)
                tighter, had = _best_open(parts, now, more, margin)
                best, early = (tighter, more) if had else (best, early)
                low, high = (middle, high) if had else (low, middle)
    margin_had, slack = margin - SATISFIED_ABOVE, int(early[now.due.argmin()])
    less = shield.config.slack > 0 and (early < np.minimum(now.asked, shield.config.slack)).any()
    lowered = bool(less or margin_had < shield.config.margin)
    return Aimed(best, best.robustness > margin, margin_had, slack, lowered, early, visits)


class Open(NamedTuple):
    """The K conjuncts at step t, and what `aim` was given of the futures.

    still: which are open. settled: above which robustness each counts as settled. asked: the slack that is
    asked for [steps]. due: in how many steps each is due, NEVER for one that is not. short: which have a past
    visit that lacks the margin and can be made again with it. known: the leaves at the steps to t.
    motion_count: how many motions the robot has.
    """

    still: Bools
    settled: Floats
    asked: Ints
    due: Ints
    t: int
    short: Bools
    known: Floats
    leaves: Floats
    whole: Floats
    motions: Ints
    motion_count: int
    follows: bool


@kernel
def _best_asked(
    boxed: Boxed[Conjuncts], now: Open, care: tuple[Noise, float, int, float], visits: Floats, margin: float
) -> tuple[Best, bool]:
    """Fills in `still`, `settled`, `asked`, `due` and `short` of `now`, then returns `_best_open` for what is
    asked. care: noise, stride, least and chance of the `Care`. A window keeps at least half its length.
    """
    (still, settled, asked, due, t, short, known), (noise, stride, least, chance) = now[:7], care
    parts = boxed.value
    find_open(boxed, known, t, np.full(settled.shape[0], margin), still, settled)
    for k in range(still.shape[0]):
        short[k] = settled[k] > SATISFIED_ABOVE and (parts.seeker == k).any()
    low = find_open(boxed, known, t, visits, still, settled)
    for k in range(still.shape[0]):
        half, due[k], asked[k] = max(parts.half[k], parts.lead[k] if parts.a[k] > t else 0), NEVER, 0
        if still[k] and half > 0:
            left = parts.b[k] + parts.horizon[k] - t
            if parts.kind[k] != EVENTUALLY:  # the first step at which its child is asked for
                left = min(left, max(parts.a[k] - t, 1) + parts.horizon[k])
            asked[k] = half if least >= half else min(slack_for(noise, stride, left, chance, least), half)
            due[k] = left
            # If the child is still open at an earlier step of the window, that is due first.
            for i in range(parts.a[k], min(t, parts.b[k]) + 1 if parts.kind[k] == ALWAYS else 0):
                if not low[parts.at[k] - parts.a[k] + i] > settled[k]:
                    due[k] = min(due[k], i + parts.horizon[k] - t)
    return _best_open(boxed, now, asked, margin)


@kernel
def _best_open(boxed: Boxed[Conjuncts], now: Open, early: Ints, margin: float) -> tuple[Best, bool]:
    """The best future of each motion, by the conjuncts that are open, and whether some rho is above `margin`.

    The way that the robot is on stays the best future of its motion if it is above the margin, even if
    another future is more robust: a robot that changes to a better way at each step may never arrive.
    """
    rho = np.empty(now.whole.shape[0])
    rate_open(boxed, now.still, now.t, now.settled, early, now.leaves, rho)
    rho[~(now.whole > SATISFIED_ABOVE)] = -np.inf
    best = best_of(now.motions, rho, now.motion_count)
    if now.follows and rho[0] > margin:
        best.row[now.motions[0, 0]] = 0
    return best, bool(best.robustness.max() > margin)
