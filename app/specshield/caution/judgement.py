"""What the futures at one step say of each action: whether it is in S_t, its J, its rho, its witness."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from specshield.arrays import Bools, Floats, Ints
from specshield.caution.aim import Aimed, aim
from specshield.caution.escape import escape
from specshield.caution.noise import EXACT, Care
from specshield.caution.residual import again, all_of, left_over
from specshield.caution.room import has_room, widened
from specshield.caution.surprise.barred import in_vain
from specshield.caution.surprise.recovery import given_up, recovers
from specshield.caution.worst import alone
from specshield.compiled import kernel
from specshield.shield.certificate import Claim
from specshield.shield.decision import Shield
from specshield.shield.feasibility import Futures, Prefix, best_of, futures, rho_of, simulated, together
from specshield.shield.proposal import adapted, ask
from specshield.stl import SATISFIED_ABOVE, Always, Formula, Verdict
from specshield.stl.conjunction import flat

LESS = 4  # [steps] V needs ways with that much less slack too, and between ways with more. Chosen by hand.


class Situation(NamedTuple):
    """What the actions at one step are judged by.

    prefix: for the whole formula. tail: what is left of the witness that the robot follows, one motion a
    byte. status: what the prefix decides. care: what J asks for beyond satisfaction.
    """

    prefix: Prefix
    tail: bytes | None
    status: Verdict
    care: Care


class Judged(NamedTuple):
    """The actions' futures at one step."""

    tried: Futures
    part: Prefix  # for the part of the formula that can still be kept
    kept: Floats  # [N], rho of that part along each future; -inf for a future that is set aside
    aimed: Aimed  # how much of the margin and the slack can be had
    feasible_motion: Bools  # [M]
    feasible: Bools  # [A], S_t; false for a terminal action
    values: Floats  # [A], J if real-valued: rho of that part; -inf where nothing was evaluated
    robustness: Floats  # [A], rho of the whole formula along the same trajectories; -inf likewise
    completion: int  # the action to execute if the model's task is over
    vain: bool  # whether every future that keeps the rule makes a motion that led nowhere before
    left_out: Bools  # [M]: motions that are set aside since only such futures of theirs keep the rule
    begun: bytes | None = None  # the future that keeps most, one motion a byte, if none keeps the rule

    @property
    def some(self) -> bool:
        """Whether some action is feasible."""
        return True in self.feasible.tolist()

    @property
    def claim(self) -> Claim:
        """What the gate is to certify (shield/certificate.py)."""
        row, lowered = self.aimed.best.row, self.aimed.lowered
        shown = self.tried, self.feasible_motion, row, self.values, self.robustness
        return Claim(*shown, self.completion, lowered)


def judge(shield: Shield, now: Situation) -> Judged:
    """Tries the futures from x_t, and judges each motion by the best of its futures."""
    prefix, tail, care, violated = now.prefix, now.tail, now.care, now.status == "violated"
    robot, roomy = shield.task.robot, care.room and not violated
    motions = len(robot.motions)
    shield, tried = _tried(shield, now, roomy)
    kept, leaves, part = tried.rho, tried.leaves, prefix
    if violated:
        tried, part = _left(shield, prefix, tried)
        kept, leaves = rho_of(part, tried.poses)
    kept, vain, left_out = _without_barred(shield, care, prefix, tried, kept)
    follows, had = recovers(shield.config) and tail is not None and len(tail) == prefix.steps, None
    if roomy:
        kept, roomy, had = _roomy(shield, care, prefix, tried, kept, follows)
    best = best_of(tried.motions, kept, motions)
    feasible, lowered = _kept(best.robustness, care.margin)
    values, aimed = best.robustness, Aimed(best, feasible, care.margin, 0, lowered)
    if lowered or ((care.least or care.noise is not EXACT) and max(values.tolist()) > SATISFIED_ABOVE):
        aimed = had or aim(shield, care, part, tried, kept, leaves, follows)
        most = aimed.slack or max(aimed.early.tolist(), default=0)
        left = ~aimed.kept & (values > SATISFIED_ABOVE)
        sooner, anew = _sooner(shield, care, prefix.t, most, True in left.tolist())
        if sooner and not violated:
            known, wanted, before = len(tried.rho), left | anew, None if anew else aimed
            for steps in sooner:
                tried = _in_time(shield, prefix, tried, care.margin, steps, wanted)
            if len(tried.rho) > known:
                kept = tried.rho
                if care.barred is not None and not vain:
                    kept = _aside(shield, care.barred, prefix, tried, kept)
                kept = _with_room(shield, prefix, tried, kept) if roomy else kept
                aimed = aim(shield, care, part, tried, kept, tried.leaves, follows, before)
                values = best_of(tried.motions, kept, motions).robustness
        best, feasible = aimed.best, aimed.kept
    if violated and recovers(shield.config):
        tried = tried._replace(warnings=(*tried.warnings, *given_up(prefix, part.formula)))
    first = tried.preferred
    if tail and feasible[tail[0]]:
        first = tail[0]
    elif True in feasible.tolist() and not feasible[first]:
        first = int(np.argmax(np.where(feasible, best.robustness, -np.inf)))
    completion = int(robot.representative[first])
    by_action = _by_action(robot.motion_of, feasible, values, best.row, tried.rho)
    return Judged(tried, part, kept, aimed, feasible, *by_action, completion, vain, left_out)


def _tried(shield: Shield, now: Situation, roomy: bool) -> tuple[Shield, Futures]:
    """The futures from x_t, also those with the margin that is asked for; and the shield with the policies
    that were asked. roomy: whether ways with room are asked for too.
    """
    prefix, asked, violated = now.prefix, now.care.margin, now.status == "violated"
    prompt = shield.config.uncertainty is not None and not now.care.guess
    hows = ["keeping_clear"] * roomy + ["promptly"] * prompt
    asks = ((each, adapted(each, how)) for how in hows for each in shield.proposers)
    more = tuple(policy for each, policy in asks if policy is not each)
    shield = replace(shield, proposers=(*shield.proposers, *more)) if more else shield
    # Several guesses about the map may be tried in one decision, so each is tried without a margin first.
    margins = (0.0,) if now.care.guess and not violated else (asked, 0.0)
    tried = futures(prefix, shield.body, shield.proposers, now.tail, margins)
    if asked not in margins and tried.rho.max() > SATISFIED_ABOVE:
        tried = together(tried, futures(prefix, shield.body, shield.proposers, None, (asked,)))
    return shield, tried


def _without_barred(
    shield: Shield, care: Care, prefix: Prefix, tried: Futures, kept: Floats
) -> tuple[Floats, bool, Bools]:
    """`kept` [N] without the futures that make a barred motion, unless all that keep the rule do; whether all
    do; and `Judged.left_out` [M].
    """
    motions = len(shield.task.robot.motions)
    if care.barred is None:
        return kept, False, np.zeros(motions, np.bool_)
    others = _aside(shield, care.barred, prefix, tried, kept)
    if others.max() <= SATISFIED_ABOVE:
        return kept, True, np.zeros(motions, np.bool_)
    before, without_it = (best_of(tried.motions, each, motions).robustness for each in (kept, others))
    return others, False, (before > SATISFIED_ABOVE) & (without_it <= SATISFIED_ABOVE)


def _roomy(
    shield: Shield, care: Care, prefix: Prefix, tried: Futures, kept: Floats, follows: bool
) -> tuple[Floats, bool, Aimed | None]:
    """`kept` [N] with -inf for the futures without room, unless room cannot be had or costs too much slack;
    whether it can be had; and the margin and the slack, where they were computed. follows: see `aim`.
    """
    apart = _with_room(shield, prefix, tried, kept)
    if max(apart.tolist()) <= SATISFIED_ABOVE:
        return kept, False, None
    had = aim(shield, care, prefix, tried, apart, tried.leaves, follows)
    if had.slack < care.least // 2:  # room may cost up to half of the slack that is asked for
        none = aim(shield, care, prefix, tried, kept, tried.leaves, follows)
        if had.slack < none.slack:
            return kept, False, none
    return apart, True, had


def _aside(shield: Shield, barred: Floats, prefix: Prefix, tried: Futures, kept: Floats) -> Floats:
    """`kept` [N], with -inf for the futures that make a barred motion. barred: see `Care`."""
    # If no policy can avoid such motions, a future that makes one only later on still counts.
    whole = any(hasattr(proposer, "avoiding") for proposer in shield.proposers)
    goes = in_vain(barred, prefix.poses[-1], tried.motions, tried.poses, whole)
    return np.where(goes, -np.inf, kept)


def _with_room(shield: Shield, prefix: Prefix, tried: Futures, kept: Floats) -> Floats:
    """`kept` [N], with -inf for the futures that come too near to an obstacle for a larger robot."""
    room = has_room(widened(shield.body), prefix.poses[-1], tried.motions, tried.poses)
    return np.where(room, kept, -np.inf)


def _sooner(shield: Shield, care: Care, t: int, most: int, some: bool) -> tuple[Sequence[int], bool]:
    """By how many steps earlier deadlines the policies are asked for more ways; and whether they are asked
    for each motion, or only for those that keep the rule without the slack that is asked for. most: the slack
    found so far. some: whether there are motions of the latter kind.
    """
    unsure = shield.config.uncertainty is not None
    if unsure and shield.config.threshold_over == "episode":  # V weighs ways with any slack
        less = [*range(care.least, most + 1, -LESS), *range(most, max(most - LESS, 0), -1)]
        return [most + 1, *(less if some else ())], True  # all ways at hand may be later than need be
    if unsure and t > 0 and not care.on_way and most < care.least:  # a surprise may have cost slack
        return [most + 1], True
    return [most] if some and most > 0 and care.on_way else [], False


def _in_time(
    shield: Shield, prefix: Prefix, tried: Futures, margin: float, steps: int, wanted: Bools
) -> Futures:
    """`tried`, and the futures that policies propose for deadlines `steps` earlier, after the first motions
    `wanted` [M] alone. Such a future may be in time where one that is just in time for the rule is not.
    """
    rows, warnings = list[Ints](), list[str]()
    for proposer in shield.proposers:
        hurried = adapted(proposer, "earlier", steps, wanted.copy())
        if hurried is not proposer:
            proposal, wrong = ask(hurried, prefix.poses, prefix.signals, margin, len(wanted), prefix.steps, 0)
            rows.extend([] if proposal is None else [proposal.motions])
            warnings.extend([] if wrong is None else [wrong])
    if not warnings and sum(map(len, rows)) == 0:
        return tried
    return together(tried, simulated(prefix, shield.body, rows, tried.preferred, warnings))


def without(judged: Judged, shield: Shield, doubtful: Bools, risky: Bools) -> Judged:
    """`judged` without the `doubtful` motions [M] or, if no other is feasible, without those of them that are
    `risky` [M]. If that leaves none either, the motions that are not doubtful and keep the rule with less
    margin and slack become feasible instead, if there are any.
    """
    if True not in doubtful.tolist():
        return judged
    robot, sure = shield.task.robot, judged.feasible_motion & ~doubtful
    if not sure.any():
        sure = judged.feasible_motion & ~risky
    if not sure.any():
        keeps = best_of(judged.tried.motions, judged.kept, len(risky))
        sure = (keeps.robustness > SATISFIED_ABOVE) & ~doubtful
        if sure.any():
            *_, robustness = _by_action(robot.motion_of, sure, keeps.robustness, keeps.row, judged.tried.rho)
            less = shield.config.margin > 0.0 or shield.config.slack > 0
            judged = judged._replace(aimed=Aimed(keeps, sure, 0.0, 0, less), robustness=robustness)
    if not sure.any() or np.array_equal(sure, judged.feasible_motion):
        return judged
    completion = judged.completion
    if not sure[robot.motion_of[completion]]:
        most = np.where(sure, judged.aimed.best.robustness, -np.inf)
        completion = int(robot.representative[np.argmax(most)])
    feasible = (robot.motion_of >= 0) & sure[robot.motion_of]
    return judged._replace(feasible_motion=sure, feasible=feasible, completion=completion)


@kernel
def _by_action(
    motion_of: Ints, feasible: Bools, values: Floats, row: Ints, rho: Floats
) -> tuple[Bools, Floats, Floats]:
    """`Judged.feasible`, `values` and `robustness`, each [A], from those of motions [M] and futures [N]."""
    count = motion_of.shape[0]
    all_feasible, all_values = np.zeros(count, np.bool_), np.full(count, -np.inf)
    robustness = np.full(count, -np.inf)
    for a in range(count):
        m = motion_of[a]
        if m >= 0:
            all_feasible[a], all_values[a] = feasible[m], values[m]
            if row[m] >= 0:
                robustness[a] = rho[row[m]]
    return all_feasible, all_values, robustness


def _left(shield: Shield, prefix: Prefix, tried: Futures) -> tuple[Futures, Prefix]:
    """The part of a violated formula that can still be kept: futures, and the prefix for that part.

    Conjuncts that cannot be kept any more are dropped. A broken G can still be enforced from a later step on.
    The following parts are tried in turn, and the first that some future keeps is chosen:

    1. all other conjuncts, and each broken G from the first step on that can be kept, the next one at most;
    2. the same, each broken G from the earliest step at which the robot can be out of the forbidden place;
    3. the same without broken G that look ahead;
    4. the conjuncts of the form G, and the broken G, at the price of what was to be reached;
    5. all other conjuncts, without the broken G.
    """
    task, t = shield.task, prefix.t
    kept, lost = left_over(prefix.formula, task.samples(prefix.poses, prefix.signals), t)
    broken = [flat(each) for each in lost]
    places = [each for each in broken if each.child.horizon == 0 and not alone(task, each)]
    guards = [flat(each) for each in kept if isinstance(each, Always) and flat(each).child.horizon == 0]

    def keeps(parts: list[Formula]) -> bool:
        return bool(rho_of(prefix.of(all_of(parts)), tried.poses)[0].max() > SATISFIED_ABOVE)

    def options() -> Iterator[list[Formula]]:
        nonlocal tried
        if broken:  # what a visit within so many steps is asked for now is not put off by a step at each step
            most = range(max(each.child.horizon for each in broken))
            late = bisect_left(most, True, key=lambda k: not keeps([*kept, *again(broken, t + 1, k + 1)]))
            yield [*kept, *again(broken, t + 1, late)]
        if places:
            steps, ways = escape(shield, prefix, places, guards)
            if ways is not None:
                tried = together(tried, ways)
            if steps > 0:
                yield [*kept, *again(broken, t + steps)]
                yield [*kept, *again(places, t + steps)]
                yield [*guards, *again(places, t + steps)]
        yield kept

    left = list[Formula]()
    for left in filter(None, options()):
        if keeps(left):
            break
    return tried, prefix.of(all_of(left)) if left else prefix


@kernel
def _kept(robustness: Floats, asked: float) -> tuple[Bools, bool]:
    """Which motions keep the margin `asked` [m], or else have the largest one; whether it was lowered so.

    robustness [M]: of each motion's best future.
    """
    feasible = robustness > SATISFIED_ABOVE + asked
    highest = robustness.max()
    if feasible.any() or not highest > SATISFIED_ABOVE:
        return feasible, False
    return robustness >= highest, True
