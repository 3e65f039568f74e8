"""Why an action is forbidden: the conjunct that fails, by how much, and how many steps too late.

An action is forbidden if no future was proposed that keeps all conjuncts. Those of its futures that keep all
conjuncts but one show which one fails. If that conjunct would be kept if its window ended later, the fewest
such steps are given. Proposers do not propose futures that come too late, so some are made here: from where
the action leads, back onto a witness of another action; and what the proposers would do if the clock stood
some steps earlier. If one of all these keeps the rule after all, the explanation says so.

Nothing here decides anything: J has been settled before.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from specshield.arrays import Bools, Floats, Ints
from specshield.caution.early import conjunction_of, find_open, rate_open
from specshield.caution.judgement import Judged
from specshield.caution.residual import again, left_over
from specshield.caution.room import ROOM
from specshield.reasons.lateness import driven, in_words, late_by, later, steps, values_of, when
from specshield.robot.dynamics import motion_count
from specshield.shield.decision import Explanation, Shield
from specshield.shield.feasibility import Prefix, rho_of
from specshield.shield.proposal import adapted, ask
from specshield.stl import SATISFIED_ABOVE, Always, Formula, conjuncts

# Chosen by hand. The last three are bounds for robots of many motions; a Stretch with seven stays below them.
DEPTH = 2  # motions after which a witness is met again
EARLIER = (1, 2, 4, 8, 16, 32)  # steps by which the proposers' clock is put back
ASKED, WITNESSES, MET = 42, 7, 49  # times that it is, in a decision; witnesses to meet; poses to do so from
SAME = 1e-6  # [m] and [rad]: poses this near are one pose

Rank = tuple[int, float]
Read = dict[str, Floats]  # what a formula reads along a future: an array [m] for each name
KEPT, KEEPS_ALL, LATE, BROKEN, SEVERAL, NOTHING = range(6)  # what a future shows, the most telling first


def explanations(
    shield: Shield, prefix: Prefix, judged: Judged | None, doubtful: Bools
) -> tuple[Explanation | None, ...]:
    """One an action: None where it is allowed, or terminal.

    prefix: for the whole formula. judged: None if the rule forbids nothing any more. doubtful [M]: the
    motions that had better not be drawn (`doubtful` in caution/taught.py).
    """
    robot = shield.task.robot
    if judged is None or not prefix.formula.names:
        return (None,) * len(robot.actions)
    shield = replace(shield, proposers=tuple(adapted(each, "briefly") for each in shield.proposers))
    found, forbidden = dict[int, Explanation](), np.flatnonzero(~judged.feasible_motion).tolist()
    for n, motion in enumerate(forbidden):
        most = ASKED * (n + 1) // len(forbidden) - ASKED * n // len(forbidden)
        found[motion] = _Motion(shield, prefix, judged, motion, bool(doubtful[motion]), most).explained()
    return tuple(found.get(motion) for motion in robot.motion_of.tolist())


@dataclass(frozen=True)
class _Motion:
    """A motion from x_t that is forbidden. most: how often the clock is put back for it."""

    shield: Shield
    prefix: Prefix
    judged: Judged
    motion: int
    doubtful: bool
    most: int

    def explained(self) -> Explanation:
        """The explanation by the most telling future: one that keeps all conjuncts, best with less to spare
        than J asks for; else one that keeps all but one, the least late or else the most robust; else the one
        that comes nearest to keeping all, with the conjunct that it keeps least.
        """
        parts, task = self.parts(), self.shield.task
        best, rank = Explanation(str(parts[0]), -math.inf, None), (NOTHING, math.inf)
        for earlier, rows in self.futures():
            if rank[0] == KEEPS_ALL or (rank[0] in (KEPT, LATE) and rank[1] <= earlier):
                break  # all further futures are as late or later
            poses = driven(self.shield, self.prefix.poses, rows)
            samples = task.samples(poses, dict(zip(task.signals, self.prefix.foreseen.T, strict=True)))
            sent = dict(zip(task.signals, self.prefix.rows.T, strict=True))
            calm = {
                name: np.broadcast_to(task.signal(name, sent, values.shape[-1]), values.shape)
                if name in task.signals
                else values
                for name, values in samples.items()
            }
            rho = np.array([values_of(part, samples) for part in parts])  # [parts, rows]
            asked = self.asked(parts, rho, poses)
            for n in range(len(rows)):
                row, steady = ({name: v[n] for name, v in each.items()} for each in (samples, calm))
                order, told = self.shows(parts, rho[:, n], asked[:, n], row, steady)
                if order < rank:
                    best, rank = told, order
        return best

    def parts(self) -> list[Formula]:
        """The conjuncts that can still be kept, and the broken G that are enforced again."""
        prefix = self.prefix
        samples = prefix.task.samples(prefix.poses, prefix.signals)
        kept, broken = left_over(prefix.formula, samples, prefix.t)
        return [*kept, *again(broken, prefix.t + 1)] or [prefix.formula]

    def asked(self, parts: Sequence[Formula], rho: Floats, poses: Floats) -> Floats:
        """The values [parts, n] of which J takes the least: rho of the conjuncts or, if margin or slack is
        asked for, for an open conjunct rho of what is asked in its place. poses [n, t + 1 + m, 3]: of the
        futures.
        """
        part, early, t, asked = self.judged.part, self.judged.aimed.early, self.prefix.t, rho.copy()
        if len(early):  # else J is made of the conjuncts as a whole
            view, joint = conjunction_of(part.task, part.formula)
            seen, settled = part.of(part.formula, view), np.empty(len(early))
            still = np.empty(len(early), np.bool_)
            _, leaves = rho_of(seen, np.ascontiguousarray(poses[:, t + 1 :]))
            find_open(joint, seen.known, t, self.judged.aimed.visits, still, settled)
            for k, each in enumerate(conjuncts(part.formula)[: len(early)]):
                if still[k] and each in parts:
                    only = np.arange(len(still)) == k
                    rate_open(joint, only, t, settled, early, leaves, asked[parts.index(each)])
        return asked

    def shows(
        self, parts: Sequence[Formula], rho: Floats, asked: Floats, row: Read, steady: Read
    ) -> tuple[Rank, Explanation]:
        """How telling a future is, and what it shows. rho [parts]: of the conjuncts; asked [parts]: see
        `asked`; row: what the formula reads along the future; steady: the same if the signals stay as they
        are now.
        """
        failing = np.flatnonzero(rho <= SATISFIED_ABOVE)
        if not len(failing):
            i = int(np.argmin(asked))
            whole = self.doubtful or asked[i] > SATISFIED_ABOVE + self.judged.aimed.margin
            late, detail = (None, self.known(parts[i], 0)) if whole else self.lacks(parts[i], row, steady)
            order = (KEEPS_ALL if whole else KEPT), late or 0
            return order, Explanation(str(parts[i]), float(rho[i]), late, detail)
        i = int(np.argmin(rho))
        late = late_by(parts[i], row, self.prefix.t) if len(failing) == 1 else None
        told = Explanation(str(parts[i]), float(rho[i]), late, self.fails(parts, i, rho, row, steady, late))
        if late is not None:
            return (LATE, late), told
        return (BROKEN if len(failing) == 1 else SEVERAL, -told.robustness), told

    def fails(
        self, parts: Sequence[Formula], i: int, rho: Floats, row: Read, steady: Read, late: int | None
    ) -> str | None:
        """How conjunct i fails on a future, and what becomes of the others; None where `late` and the
        robustness say it all. rho [parts], row, steady: as in `shows`.
        """
        conjunct, task = parts[i], self.prefix.task
        words = in_words(conjunct, row, self.prefix.t, late)
        others = [f"'{part}'" for n, part in enumerate(parts) if n != i and rho[n] <= SATISFIED_ABOVE]
        unit = " m" if set(conjunct.names) <= {"x", "y", *task.areas} else ""
        missed, called = f"it falls short by {abs(rho[i]):.3g}{unit}", self.called(conjunct, steady)
        if words is None:
            if len(parts) == 1 and not called:
                return None
            words = missed if late is None else f"it comes {steps(late)} too late"
        elif late is None and not others:
            by = "by" if isinstance(conjunct, Always) else "and the part is missed by"
            words = f"{words}, {by} {abs(rho[i]):.3g}{unit}"
        words += called
        if others:
            return f"{words}, and it does not keep {' and '.join(others)} either"
        return f"{words}, while the rest of the rule is kept" if len(parts) > 1 else words

    def called(self, part: Formula, steady: Read) -> str:
        """Words to add to what fails only because the signals are taken to do their worst."""
        if float(values_of(part, steady)) <= SATISFIED_ABOVE:
            return ""
        names = [name for name in self.prefix.task.signals if name in part.names]
        return f", if the signal {names[0]} changes" if len(names) == 1 else ", if the signals change"

    def lacks(self, part: Formula, row: Read, steady: Read) -> tuple[int | None, str]:
        """For a conjunct that is kept along `row`, but not with the margin or the slack that J asks for: how
        many steps too late it is for that, None if time is not what it lacks; and what it lacks, in words.
        """
        parts, early = conjuncts(self.judged.part.formula), self.judged.aimed.early.tolist()
        reserve = dict(zip(parts, early, strict=False)).get(part, 0)
        asked = later(part, -reserve) if reserve else None
        if asked is not None and float(values_of(asked, row)) <= SATISFIED_ABOVE:
            late = late_by(asked, row, self.prefix.t)
            if late is not None:
                return late, (
                    f"a way was found after it that keeps the rule, but none with the {steps(reserve)} in "
                    f"reserve that other actions leave: on the best one {when(asked, late)} for that"
                    f"{self.called(asked, steady)}"
                )
        return None, self.known(part, reserve)

    def known(self, part: Formula, reserve: int) -> str:
        """Why the motion is forbidden though a known future keeps the rule. reserve: the slack asked for."""
        if self.doubtful:
            return (
                "the rule could still be kept, but only by what led nowhere before, or by an obstacle that "
                "would have to stop the robot in time"
            )
        judged, own = self.judged, self.judged.tried.motions[:, 0] == self.motion
        found = judged.tried.rho[own].max(initial=0.0) > SATISFIED_ABOVE
        if found and judged.kept[own].max(initial=0.0) <= SATISFIED_ABOVE:
            return (
                f"the rule could still be kept, but every way that was found leads closer than {ROOM:g} m to "
                "an obstacle, where a robot that cannot drive backwards may get stuck"
            )
        if not found:
            return "a way is known that keeps the rule, but the policies did not find it"
        return (
            f"the rule could still be kept, but no way that was found leaves as much of '{part}' to spare as "
            f"other actions do ({judged.aimed.margin:.2g} m, {steps(reserve)})"
        )

    def futures(self) -> Iterator[tuple[int, Ints]]:
        """Motions [n, m] from x_t that begin with this one and go on to the horizon or beyond; with each, by
        how many steps at least it comes too late.
        """
        shield, prefix, tried = self.shield, self.prefix, self.judged.tried
        own = tried.motions[tried.motions[:, 0] == self.motion]
        yield 0, own if len(own) else np.full((1, prefix.steps), self.motion)
        x_next = driven(shield, prefix.poses[-1:], np.array([[self.motion]]))[0, -1]
        for ways in self.rejoined(x_next).values():
            yield 0, np.array(ways)
        before, possible = 0, [each for each in EARLIER if each <= prefix.t + 1]
        for earlier in possible[max(len(possible) - self.most, 0) :]:
            # As though x_{t+1} were reached `earlier` steps sooner than it is.
            upto = prefix.t + 1 - earlier
            history = np.concatenate([prefix.poses[:upto], x_next[None]])
            signals = {name: np.append(values[:upto], values[-1:]) for name, values in prefix.signals.items()}
            left, count = prefix.task.horizon - upto, motion_count(shield.body)
            for proposer in shield.proposers if left > 0 else ():
                given, _ = ask(proposer, history, signals, 0.0, count, left)
                if given is not None:
                    first = given.motions[given.motions[:, 0] == given.preferred]  # the others are no sooner
                    yield before, np.column_stack([np.full(len(first), self.motion), first])
            before = earlier

    def rejoined(self, x_next: Floats) -> dict[int, list[Ints]]:
        """Ways that go on by another action's witness from where it is met again, by the steps they lose."""
        shield, tried, x_t = self.shield, self.judged.tried, self.prefix.poses[-1:]
        rows = self.judged.aimed.best.row[self.judged.feasible_motion][:WITNESSES]
        ways = [(tried.motions[row], np.concatenate([x_t, tried.poses[row]])) for row in rows]
        front, found = [(x_next, [self.motion])], dict[int, list[Ints]]()
        for _ in range(DEPTH + 1 if ways else 0):
            for pose, taken in front:
                for motions, poses in ways:
                    off = np.abs(poses[: len(taken)] - pose)
                    turned = np.minimum(off[:, 2], 2.0 * math.pi - off[:, 2])
                    met = np.flatnonzero(np.maximum(off[:, :2].max(axis=1), turned) < SAME)
                    if len(met):
                        way = np.append(taken, motions[met[-1] :])
                        found.setdefault(len(taken) - int(met[-1]), []).append(way)
            if found or len(front) * motion_count(shield.body) > MET:
                break
            each = np.arange(motion_count(shield.body))[:, None]
            front = [
                (end, [*taken, m])
                for pose, taken in front
                for m, end in enumerate(driven(shield, pose[None], each)[:, -1])
            ]
        return dict(sorted(found.items()))
