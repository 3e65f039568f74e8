"""A search for a future that satisfies a formula, without policies: step by step, in simulation.

Each pose that is reached carries what is left of the formula there (remainder.py). The search begins with
every pose that one motion leads to. For each formula that is left, it goes on from the poses that leave the
most steps to spare on the way to what that formula needs (needs.py, ground.py). It goes on once from a place
with the same formula left, since a robot can wait anywhere, and again if waiting has changed what is left.
What it finds is simulated with f and can be judged like any other future. If it finds nothing, that proves
nothing.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from specshield.arrays import Bools, Floats, Ints
from specshield.caution.escape import spread
from specshield.reasons.course import Goal, course_from
from specshield.reasons.ground import Ground
from specshield.reasons.known import Known
from specshield.reasons.needs import Reader, positive
from specshield.reasons.remainder import Left, after, begun, implies, next_change
from specshield.robot.dynamics import Body, calmest_motion, motion_count
from specshield.stl import SATISFIED_ABOVE, And, Formula, Not, Or
from specshield.stl.conjunction import is_predicate
from specshield.stl.formula import Node

# Chosen by hand: a search takes two seconds at most.
MOST_NODES = 40_000
MOST_LEFT = 4_000  # different formulas that are left
MOST_WORK = 1_000_000  # pairs of parts of such formulas that are compared, about
MOST_PREDICATES = 40  # their truths at a pose are the lower bits of a number
WIDTH = 120  # poses that one step goes on from, for each formula that is left
MOST_MOTIONS = 1_500  # made from all of these poses
BEHIND = 8.0  # [steps] such a pose may have fewer to spare than the best one: what it takes to turn round
CELL, HEADINGS = 0.05, 120  # poses in one cell [m] and one of so many headings are one place
MOST_WAYS, MOST_GOALS = 4, 8  # alternatives of one formula, and goals of one alternative, that are looked at
LOST, DONE = 0, 1  # the numbers of False and True among the formulas that are left


class _TooMuchError(Exception):
    """The formulas that are left take too much work."""


Seen = set[tuple[int, int]]  # places that the search went on from, with what was left there


class Place(NamedTuple):
    """Poses [n, 3] that are reached, each with its node, the number of what is left there, and the truths of
    the predicates.
    """

    node: Ints
    poses: Floats
    left: Ints
    truths: Ints

    def of(self, which: Ints | Bools) -> Place:
        return Place(self.node[which], self.poses[which], self.left[which], self.truths[which])

    def and_(self, other: Place) -> Place:
        node, poses = np.append(self.node, other.node), np.concatenate([self.poses, other.poses])
        return Place(node, poses, np.append(self.left, other.left), np.append(self.truths, other.truths))


@dataclass
class _Tree:
    """The poses that were reached: for each node its step, its parent and the motion that led there."""

    rows: list[tuple[Ints, Ints, Ints]] = field(default_factory=list)
    size: int = 0

    def add(self, step: int, parent: Ints, motion: Ints) -> Ints:
        self.rows.append((np.full(len(parent), step), parent, motion))
        self.size += len(parent)
        return np.arange(self.size - len(parent), self.size)

    def way(self, node: int, wait: int) -> list[int]:
        """The motions to a node; the robot waits if more than one step lies between two nodes."""
        step, parent, motion = (np.concatenate(each) for each in zip(*self.rows, strict=True))
        back: list[int] = []
        while parent[node] >= 0:
            before = int(parent[node])
            back += [int(motion[node]), *[wait] * int(step[node] - step[before] - 1)]
            node = before
        return back[::-1]


@dataclass
class _Lefts:
    """What may be left of the formula, numbered, and the goals that lead to keeping it."""

    known: Known
    ground: Ground
    predicates: tuple[Formula, ...]
    all: list[Left] = field(default_factory=lambda: [False, True])
    number: dict[Left, int] = field(default_factory=lambda: {False: LOST, True: DONE})
    next: dict[tuple[int, int, int], int] = field(default_factory=dict)
    implied: dict[tuple[int, int], bool] = field(default_factory=dict)
    goals: dict[int, tuple[int, tuple[tuple[Goal, ...], ...]]] = field(default_factory=dict)
    work: int = 0

    def count(self, work: int) -> None:
        """Raises _TooMuchError once all work together is more than MOST_WORK."""
        self.work += work
        if self.work > MOST_WORK:
            raise _TooMuchError

    def numbered(self, left: Left) -> int:
        if left not in self.number:
            self.number[left] = len(self.all)
            self.all.append(left)
        return self.number[left]

    def truths(self, poses: Floats) -> Ints:
        bits = np.zeros(len(poses), np.int64)
        for k, predicate in enumerate(self.predicates):
            bits |= self.known.at(predicate, poses, SATISFIED_ABOVE).astype(np.int64) << k
        return bits

    def begun(self) -> int:
        """What is left after the steps that are known."""
        past = [self.known.past(each) for each in self.predicates]
        left: Left = True
        for step in range(self.known.now + 1):
            true = (bool(each[min(step, len(each) - 1)]) for each in past)
            holds = dict(zip(self.predicates, true, strict=True)).__getitem__
            self.count(_parts(left) ** 2)
            left = after(left, step, holds) if step > 0 else begun(self.known.task.formula, holds)
        return self.numbered(left)

    def after(self, left: Ints, truths: Ints, step: int) -> Ints:
        """What is left of each [n] after a step with these truths [n]."""
        both, which = np.unique(left << len(self.predicates) | truths, return_inverse=True)
        bits = len(self.predicates)
        found = [self._after(each >> bits, each & ~(-1 << bits), step) for each in both.tolist()]
        return np.array(found, np.int64)[which]

    def kept_by_waiting(self, left: int, truths: int, step: int) -> bool:
        """Whether the formula is kept if the predicates hold for ever as they do at this step."""
        while left not in (LOST, DONE):
            step += 1
            further = self._after(left, truths, step)
            step = max(next_change(self.all[left], step) - 1, step) if further == left else step
            left = further
        return left == DONE

    def _after(self, left: int, truths: int, step: int) -> int:
        key = left, truths, step
        if key not in self.next:
            self.count(_parts(self.all[left]) ** 2 + 50)
            index = {each: k for k, each in enumerate(self.predicates)}
            found = after(self.all[left], step, lambda each: bool(truths >> index[each] & 1))
            self.next[key] = self.numbered(found)
        return self.next[key]

    def asks_more(self, left: int, others: Iterable[int]) -> bool:
        """Whether what is left asks for as much as one of the others, or more."""
        for other in others:
            key = left, other
            if key not in self.implied:
                self.count(_parts(self.all[left]) * _parts(self.all[other]) + 1)
                self.implied[key] = implies(self.all[left], self.all[other])
            if self.implied[key]:
                return True
        return False

    def courses(self, left: int, step: int) -> tuple[tuple[Goal, ...], ...]:
        """The goals of each alternative of what is left after a step; none if it cannot be kept."""
        until, found = self.goals.get(left, (-1, ()))
        if step > until:  # a G asks for its child at other steps now
            formula, reader = self.all[left], Reader(self.known.now, self.known.constant)
            assert isinstance(formula, Formula)
            ways = reader.from_step(formula, step + 1)[:MOST_WAYS]
            asked = [course_from(needs, step, self.ground) for needs in ways]
            found = tuple(each.goals[:MOST_GOALS] for each in asked if not isinstance(each, str))
            until = min((goal.need.last for goals in found for goal in goals), default=formula.horizon)
            self.goals[left] = until, found
        return found

    def spare(self, left: int, poses: Floats, step: int) -> Floats:
        """The steps to spare at each pose [n, 3] on the way to what is left; -inf where it is too late."""
        at, best = self.ground.squares(poses), np.full(len(poses), -np.inf)
        for goals in self.courses(left, step):
            spare = np.full(len(poses), np.inf)
            for goal in goals:
                slack = goal.need.last - step - self.ground.steps(goal.far[at])
                spare = np.minimum(spare, np.where(slack < 0.0, -np.inf, slack))
            best = np.maximum(best, spare)
        return best


def _parts(left: Left) -> int:
    return len(left.children) if isinstance(left, And | Or) else 1


def search(known: Known, ground: Ground, body: Body, most: int = MOST_NODES) -> tuple[Ints | None, int]:
    """Motions from x_t to the horizon that satisfy the task's formula, None where none were found; and how
    many poses were gone on from, at most about `most`. A search that gives up on the formulas counts as one
    that looked at so many.
    """
    try:
        return _search(known, ground, body, most)
    except _TooMuchError:
        return None, most


def _search(known: Known, ground: Ground, body: Body, most: int) -> tuple[Ints | None, int]:
    wait, now, tree, until = calmest_motion(body), known.now, _Tree(), known.task.horizon
    waits, count = known.task.robot.wait_motion >= 0, motion_count(body)
    lefts = _Lefts(known, ground, tuple(dict.fromkeys(_predicates(positive(known.task.formula)))))
    if len(lefts.predicates) > MOST_PREDICATES:
        return None, 0
    here = known.history[-1:]
    nodes = tree.add(now, np.array([-1]), np.array([-1]))
    last = Place(nodes, here, np.array([lefts.begun()]), lefts.truths(here))
    pool, seen = last, Seen()
    for step in range(now + 1, max(until, now) + 2):
        done = _done(lefts, last, step - 1, waits)
        if done is not None:
            way = tree.way(done, wait)
            return np.array(way + [wait] * (until - now - len(way)), np.int64), tree.size
        if step > until:
            break
        poses = spread(body, last.poses)
        truths = lefts.truths(poses)
        left = lefts.after(np.repeat(last.left, count), truths, step)
        moved = Place(np.arange(len(poses)), poses, left, truths)
        seen = seen if waits else Seen()
        moved = moved.of(_new(lefts, moved, step, seen))
        parent, motion = np.divmod(moved.node, count)
        moved = moved._replace(node=tree.add(step, last.node[parent], motion))
        if waits:
            left = lefts.after(pool.left, pool.truths, step)
            new, pool = left != pool.left, pool._replace(left=left)
            changed = pool.of(new)
            last = moved.and_(changed.of(_new(lefts, changed, step, seen)))
            pool = pool.of(left != LOST).and_(moved)
        else:
            last = moved
        ended = not len(last.node) and not (waits and len(pool.node))
        if ended or tree.size > most or len(lefts.all) > MOST_LEFT:
            break
    return None, tree.size


def _predicates(formula: Node) -> Iterator[Formula]:
    """Every predicate that what is left of the formula may ask for."""
    if is_predicate(formula) and isinstance(formula, Formula):
        yield formula
        return
    if isinstance(formula, Not):  # of an `until`: what is left of its parts is negated
        for part in formula.child.parts:
            yield from _predicates(positive(part, True)) if isinstance(part, Formula) else ()
    for part in formula.parts:
        yield from _predicates(part)


def _done(lefts: _Lefts, last: Place, step: int, waits: bool) -> int | None:
    """The node from which the formula is kept by waiting, or by whatever a robot does that cannot wait."""
    bits = len(lefts.predicates)
    both, first = np.unique(last.left << bits | last.truths, return_index=True)
    for each, at in zip(both.tolist(), first.tolist(), strict=True):
        left, truths = each >> bits, each & ~(-1 << bits)
        if left == DONE or (waits and lefts.kept_by_waiting(left, truths, step)):
            return int(last.node[at])
    return None


def _new(lefts: _Lefts, place: Place, step: int, seen: Seen) -> Ints:
    """The poses to go on from: for each formula that is left, those with the most steps to spare. Of poses at
    one place, those where more is left do not count. Adds them to `seen`.
    """
    here: dict[int, dict[int, int]] = {}
    keys, left_at = _key(place.poses).tolist(), place.left.tolist()
    for row, (key, left) in enumerate(zip(keys, left_at, strict=True)):
        others = here.get(key, {})
        if left == LOST or (key, left) in seen or lefts.asks_more(left, others):
            continue
        here[key] = {other: at for other, at in others.items() if not lefts.asks_more(other, (left,))}
        here[key][left] = row
    rows = np.sort(np.array([row for found in here.values() for row in found.values()], np.int64))
    chosen = []
    width = max(1, min(WIDTH, MOST_MOTIONS // len(lefts.known.task.robot.motions)))
    for left in np.unique(place.left[rows]).tolist():
        same = rows[place.left[rows] == left]
        if left != DONE:
            spare = lefts.spare(left, place.poses[same], step)
            order = np.argsort(-spare, kind="stable")
            same, spare = same[order], spare[order]
            same = same[(spare > -np.inf) & (spare >= spare[0] - BEHIND)]
        chosen.append(same[:width])
    found = np.concatenate(chosen) if chosen else rows
    seen.update((keys[row], left_at[row]) for row in found.tolist())
    return found


def _key(poses: Floats) -> Ints:
    """One number for each place."""
    cells = np.floor(poses[:, :2] / CELL).astype(np.int64) & 0xFFFF
    heading = np.round(poses[:, 2] * HEADINGS / (2.0 * math.pi)).astype(np.int64) % HEADINGS
    return (cells[:, 0] << 16 | cells[:, 1]) * HEADINGS + heading
