"""Why an action is forbidden: the conjunct that fails, by how much, and how many steps too late.

An action is forbidden where none of its futures keeps all conjuncts. Of its futures, those that keep all
conjuncts but one say which one that is. Where that conjunct would be kept if its window ended later, the
fewest such steps are given. Futures that come too late are not proposed as such, so some are made here: from
where the action leads, back onto a witness of another action; and what the proposers would do if the clock
stood some steps earlier.

Nothing here decides anything: what an action's J is has been settled before.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from specshield.arrays import Floats, Ints
from specshield.errors import SampleError
from specshield.robot.dynamics import motion_count, simulate, step
from specshield.rule.residual import again, left_over, still_open
from specshield.shield.decision import Explanation, Shield
from specshield.shield.feasibility import Prefix
from specshield.shield.judgement import Judged
from specshield.shield.proposal import ask
from specshield.stl import SATISFIED_ABOVE, Always, Eventually, Formula, Implies, Until, robustness

# Chosen by hand; an explanation costs some 10 ms.
DEPTH = 2  # motions after which a witness is met again
EARLIER = (1, 2, 4, 8, 16, 32)  # steps by which the proposers' clock is put back
SAME = 1e-6  # [m] and [rad]: poses this near are one pose


@dataclass(frozen=True)
class _Part:
    """A conjunct as the formula has it, and what J asks for in its place."""

    conjunct: Formula
    asked: Formula


def explanations(
    shield: Shield, prefix: Prefix, judged: Judged | None, margin: float, slack: int
) -> tuple[Explanation | None, ...]:
    """One an action: None where it is allowed, or terminal.

    prefix: as the whole formula sees it. judged: None where the rule forbids nothing any more. margin [m],
    slack [steps]: what J asked for.
    """
    robot = shield.task.robot
    if judged is None or not prefix.formula.names:
        return (None,) * len(robot.actions)
    parts = _parts(prefix, slack)
    found: dict[int, Explanation] = {}
    for motion in np.flatnonzero(~judged.feasible_motion).tolist():
        found[motion] = _explained(shield, prefix, judged, motion, parts, SATISFIED_ABOVE + margin)
    return tuple(found.get(motion) for motion in robot.motion_of.tolist())


def _parts(prefix: Prefix, slack: int) -> list[_Part]:
    """The conjuncts that can still be kept, and the broken G that are enforced again."""
    kept, broken = left_over(prefix.formula, prefix.task.samples(prefix.poses, prefix.signals), prefix.t)
    parts = [
        _Part(each, still_open(prefix.task, each, prefix.poses, prefix.rows, slack) if slack else each)
        for each in kept
    ]
    parts += [_Part(each, again([each], prefix.t + 1)[0]) for each in broken]
    return parts or [_Part(prefix.formula, prefix.formula)]


def _explained(
    shield: Shield, prefix: Prefix, judged: Judged, motion: int, parts: Sequence[_Part], above: float
) -> Explanation:
    """Of the futures that keep all conjuncts but one the least late, else the most robust of them; where
    there are none, the future that comes nearest to keeping all, and the conjunct that it keeps least.
    """
    best: Explanation | None = None
    nearest, rank = Explanation(str(parts[0].conjunct), -math.inf, None), (2, math.inf)
    for earlier, rows in _futures(shield, prefix, judged, motion):
        if rank[0] == 0 and rank[1] <= earlier:
            break  # what comes now is as late or later
        samples = samples_of(shield, prefix.poses, prefix.foreseen, rows)
        rho = np.array([values_of(part.asked, samples) for part in parts])  # [parts, rows]
        for n, i in enumerate(np.argmin(rho, axis=0)):
            same = parts[i].conjunct is parts[i].asked
            robustness = float(rho[i, n] if same else values_of(parts[i].conjunct, samples)[n])
            if (rho[:, n] <= above).sum() != 1:
                if robustness > nearest.robustness:
                    nearest = Explanation(str(parts[i].conjunct), robustness, None)
                continue
            row = {name: values[n] for name, values in samples.items()}
            late = late_by(parts[i].asked, row, above)
            order = (1, -robustness) if late is None else (0, late)
            if order < rank:
                # Of the rule's own window, not of the one that slack cuts short.
                if robustness <= SATISFIED_ABOVE:
                    late = late_by(parts[i].conjunct, row, SATISFIED_ABOVE)
                best, rank = Explanation(str(parts[i].conjunct), robustness, late), order
    return best or nearest


def _futures(shield: Shield, prefix: Prefix, judged: Judged, motion: int) -> Iterator[tuple[int, Ints]]:
    """Motions [n, m] from x_t that begin with `motion`, to the horizon or to some steps after it; and of how
    many steps at least what they keep would come too late.
    """
    own = judged.tried.motions[judged.tried.motions[:, 0] == motion]
    yield 0, own if len(own) else np.full((1, prefix.steps), motion)
    x_next = _after(shield, prefix.poses[-1], motion)
    for ways in _rejoined(shield, prefix, judged, motion, x_next).values():
        yield 0, np.array(ways)
    before = 0
    for earlier in EARLIER:
        if earlier > prefix.t + 1:
            return
        # As though x_{t+1} were reached `earlier` steps sooner than it is.
        upto = prefix.t + 1 - earlier
        history = np.concatenate([prefix.poses[:upto], x_next[None]])
        signals = {name: np.append(values[:upto], values[-1:]) for name, values in prefix.signals.items()}
        steps, count = prefix.task.horizon - upto, motion_count(shield.body)
        for proposer in shield.proposers if steps > 0 else ():
            given, _ = ask(proposer, history, signals, 0.0, count, steps)
            if given is not None:
                yield before, np.column_stack([np.full(len(given.motions), motion), given.motions])
        before = earlier


def _rejoined(
    shield: Shield, prefix: Prefix, judged: Judged, motion: int, x_next: Floats
) -> dict[int, list[Ints]]:
    """Goes on by the witness of another action from where that is met again: ways by the steps they lose."""
    tried, found = judged.tried, dict[int, list[Ints]]()
    rows = judged.best.row[judged.feasible_motion].tolist()
    ways = [(tried.motions[row], np.concatenate([prefix.poses[-1:], tried.poses[row]])) for row in rows]
    front = [(x_next, [motion])]
    for depth in range(DEPTH + 1 if ways else 0):
        for pose, taken in front:
            for motions, poses in ways:
                off = np.abs(poses[: len(taken)] - pose)
                turned = np.minimum(off[:, 2], 2.0 * math.pi - off[:, 2])
                met = np.flatnonzero(np.maximum(off[:, :2].max(axis=1), turned) < SAME)
                if len(met):
                    found.setdefault(len(taken) - int(met[-1]), []).append(
                        np.append(taken, motions[met[-1] :])
                    )
        if found:
            break
        if depth < DEPTH:
            front = [
                (_after(shield, pose, m), [*taken, m])
                for pose, taken in front
                for m in range(motion_count(shield.body))
            ]
    return dict(sorted(found.items()))


def _after(shield: Shield, pose: Floats, motion: int) -> Floats:
    x, y, theta = pose.tolist()
    return np.array(step(shield.body, x, y, theta, motion), np.float64)


def samples_of(
    shield: Shield, history: Floats, signals: Mapping[str, Floats], motions: Ints
) -> dict[str, Floats]:
    """What the formula reads along x_0..x_t and each row of motions [n, m]: {name: [n, t + 1 + m]}."""
    return shield.task.samples(driven(shield, history, motions), signals)


def driven(shield: Shield, history: Floats, motions: Ints) -> Floats:
    """x_0..x_t and where each row of motions [n, m] leads: [n, t + 1 + m, 3]."""
    poses = np.empty((len(motions), len(history) + motions.shape[1], 3))
    poses[:, : len(history)] = history
    for row, joined in zip(motions, poses, strict=True):
        simulate(shield.body, history[-1], np.ascontiguousarray(row, np.int64), joined[len(history) :])
    return poses


def values_of(formula: Formula, samples: Mapping[str, Floats]) -> Floats:
    """rho along each trajectory, -inf on all where the formula's arithmetic is not finite on one of them."""
    some = next(iter(samples.values()))
    try:
        return np.broadcast_to(robustness(formula, {n: samples[n] for n in formula.names}), some.shape[:-1])
    except SampleError:
        return np.full(some.shape[:-1], -np.inf)


def late_by(part: Formula, samples: Mapping[str, Floats], above: float) -> int | None:
    """The fewest steps later that the window of an F or U would have to end for its rho to be above `above`;
    None where no later end that the samples [m] reach would do.
    """
    if ends_later(part, 1) is None:
        return None

    def kept(late: int) -> bool:
        return float(values_of(ends_later(part, late) or part, samples)) > above

    low, high = 0, min(len(values) for values in samples.values()) - 1 - part.horizon
    if high < 1 or not kept(high):
        return None
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if kept(middle) else (middle, high)
    return high


def ends_later(part: Formula, late: int) -> Formula | None:
    """The same with the window of its F or U, alone or below a G as in a patrol, ending so much later."""
    match part:
        case Eventually() | Until():
            return replace(part, b=part.b + late)
        case Always(child=child) if later := ends_later(child, late):
            return replace(part, child=later)
        case Implies(right=right) if later := ends_later(right, late):
            return replace(part, right=later)
    return None
