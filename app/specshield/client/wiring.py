"""Finds what a robot's loop got wrong for good: a sign, a unit, a frame, the order of actions, old poses.

No rule can be kept for a robot that turns right where `left` is executed. Noise, slips and contacts hinder
single motions; such a mistake shows in nearly all of them, and always in the same way.
"""

from __future__ import annotations

import cmath
import logging
import math
import re
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import NamedTuple

from specshield.client.models import Decision, Pose

KEPT = 24  # [motions] looked at: a mistake shows in a few seconds, and one of long ago does not count
ENOUGH = 6  # [motions] that only the mistake explains; chosen by hand
# By how much a motion may differ and still count as executed: a part of its length, plus three times the
# noise of a robot (0.01 m and 0.5 degrees) and as much for its localisation.
PART, FAR, TURNED = 0.3, 0.06, 0.05  # [m], [rad]
MANY = 10  # [motions] strides, or turns, that are compared for a factor that they share; chosen by hand
OFF = 0.3  # that factor differs from 1 by more: with less, a session's slack still suffices
HELD = 0.3  # a robot whose motions are shorter than this share of what they should be is held by something
LONGER = (
    "the robot's strides are {:.2g} times as long as its actions say; poses and `translate` are in metres"
)
WIDER = "the robot's turns are {:.2g} times as wide as its actions say; theta and `rotate` are in radians"
UNTURNED = "the robot does not turn: send its new heading with each pose; or something keeps it from turning"
NUMBERS = re.compile(r"(?<![\[,\w])\d[\d.]*")  # but not windows, by which the parts of a rule differ
log = logging.getLogger("specshield")


Move = tuple[complex, float]  # from the robot before it: forward + left i [m], a turn to the left [rad]
STILL: Move = (0j, 0.0)


class Motion(NamedTuple):
    """A step by which the robot was to move. told: by the action that was executed. found: by the poses.
    leads: where each action leads.
    """

    action: int
    told: Move
    found: Move
    before: Pose
    leads: tuple[Pose, ...]


class Wiring:
    """What the last motions of a session led to. A mistake that they show is logged, once; and so is each
    warning of a decision.

    said: the warnings that were logged, without their numbers, since these differ from step to step.
    """

    def __init__(self, session: str, said: set[str] | None = None) -> None:
        self._session, self.said = session, set[str]() if said is None else said
        self._last: tuple[int, Pose, Decision] | None = None
        self._motions: deque[Motion] = deque(maxlen=KEPT)
        self._told = False

    def note(self, t: int, pose: Pose, decision: Decision, executed: bool) -> None:
        """Notes x_t [m, m, rad] and the decision there. executed: whether its `execute` will be run."""
        for warning in decision.warnings:
            words = NUMBERS.sub("", warning)
            if words not in self.said:
                self.said.add(words)
                log.warning("session %s: step %d: %s", self._session, t, warning)
        last, self._last = self._last, (t, pose, decision) if executed else None
        if self._told or last is None or last[0] + 1 != t:
            return
        before, action = last[1], last[2].execute
        leads = last[2].next_poses
        motion = Motion(action, between(before, leads[action]), between(before, pose), before, leads)
        if motion.told == STILL:
            return
        self._motions.append(motion)
        wrong = None if alike(motion.found, motion.told) else diagnosed(self._motions, last[2].action_names)
        wrong = wrong or scaled(self._motions)
        if wrong is not None:
            self._told = True
            log.warning("session %s: %s", self._session, wrong)


def between(before: Pose, after: Pose) -> Move:
    """The motion between two poses."""
    way = complex(after[0] - before[0], after[1] - before[1]) * cmath.exp(-1j * before[2])
    return way, math.remainder(after[2] - before[2], math.tau)


def alike(one: Move, other: Move) -> bool:
    """Whether the first motion may be the second, with noise."""
    turned = abs(math.remainder(one[1] - other[1], math.tau))
    near = abs(one[0] - other[0]) <= FAR + PART * abs(other[0])
    return near and turned <= TURNED + PART * abs(other[1])


def diagnosed(motions: Sequence[Motion], names: Sequence[str]) -> str | None:
    """The mistake that explains at least ENOUGH motions that were not executed as told, and three quarters of
    all such, while it contradicts next to none of those that were. None if there is no such mistake.
    """
    kept = [alike(each.found, each.told) for each in motions]
    if kept.count(False) < ENOUGH:
        return None
    best, words = ENOUGH - 1, None
    for told, made in mistakes(motions, names):
        both = zip(motions, made, strict=True)
        explains = [move is not None and alike(each.found, move) for each, move in both]
        only = sum(yes and not was for yes, was in zip(explains, kept, strict=True))
        against = sum(was and not yes for yes, was in zip(explains, kept, strict=True))
        if only > best and only >= 0.75 * kept.count(False) and 8 * against <= only:
            best, words = only, told
    return words


def scaled(motions: Sequence[Motion]) -> str | None:
    """What is wrong if strides, or turns, are all longer or shorter by nearly the same factor: each of them
    alone may be noise. None if nothing is.
    """
    strides = [(each.found[0] / each.told[0]).real for each in motions if abs(each.told[0]) > FAR / 3]
    turns = [each.found[1] / each.told[1] for each in motions if abs(each.told[1]) > TURNED / 3]
    for ratios, words in ((strides, LONGER), (turns, WIDER)):
        if len(ratios) >= MANY:
            factor = _middle(ratios)
            spread = _middle(abs(each - factor) for each in ratios)
            if factor > HELD and abs(factor - 1.0) > max(OFF, 4.0 * spread):
                return words.format(factor)
    return None


def mistakes(motions: Sequence[Motion], names: Sequence[str]) -> Iterator[tuple[str, list[Move | None]]]:
    """The mistakes that are looked for, in words, each with what it makes of the motions: None of a motion of
    which it says nothing.
    """
    told, headings = [each.told for each in motions], [each.before[2] for each in motions]

    def strides_as(change: Callable[[complex], complex]) -> list[Move | None]:
        return [(change(way), turn) for way, turn in told]

    def mirrored(mirror: Callable[[complex], complex]) -> list[Move | None]:
        """The strides with their directions on the map mirrored."""
        on_map = [cmath.exp(1j * theta) for theta in headings]
        return [(mirror(way * on) / on, turn) for (way, turn), on in zip(told, on_map, strict=True)]

    yield (
        "the poses do not change: send the robot's new pose at each step; or something holds the robot",
        [STILL] * len(motions),
    )
    yield (
        "the poses are a step old: each shows what the motion before the last one did; send the pose "
        "once the motion has ended",
        [None, *told[:-1]],
    )
    yield (
        "the robot turns the other way: theta and `rotate` grow counter-clockwise, on a map whose y axis "
        "points up; or its actions for left and right are exchanged",
        [(way, -turn) for way, turn in told],
    )
    yield "the robot moves backwards where it should move forward", strides_as(lambda way: -way)
    yield (
        "theta is in degrees, and should be in radians",
        [
            (way * cmath.rect(1.0, math.radians(theta) - theta), math.remainder(math.degrees(turn), math.tau))
            for (way, turn), theta in zip(told, headings, strict=True)
        ],
    )
    yield "the y axis of the poses points the other way than that of the map", mirrored(complex.conjugate)
    yield "x and y of the poses are exchanged", mirrored(lambda way: 1j * way.conjugate())
    strides = [each for each in motions if min(abs(each.told[0]), abs(each.found[0])) > FAR]
    if strides:
        aside = cmath.phase(sum(each.found[0] / each.told[0] / abs(each.found[0]) for each in strides))
        where = f"{abs(math.degrees(aside)):.0f} degrees to the {'left' if aside > 0 else 'right'}"
        yield (
            f"the robot moves {where} of its heading: theta is 0 where it looks along the map's x axis",
            strides_as(lambda way: way * cmath.exp(1j * aside)),
        )
        longer = _middle(abs(each.found[0]) / abs(each.told[0]) for each in strides)
        yield LONGER.format(longer), strides_as(lambda way: longer * way)
    turns = [each for each in motions if abs(each.told[1]) > TURNED]
    if turns:
        wider = _middle(each.found[1] / each.told[1] for each in turns)
        words = UNTURNED if abs(wider) <= HELD else WIDER.format(wider)
        yield words, [(way, wider * turn) for way, turn in told]
    done = {action: _done(motions, action) for action in {each.action for each in motions}}
    exchanged = [
        f"{names[a]!r} does what {names[b]!r} should do" for a, b in done.items() if b not in (a, None)
    ]
    if names and exchanged:
        like = [(each, done[each.action]) for each in motions]
        yield (
            f"the actions have another order: {', and '.join(exchanged)}",
            [None if b is None else between(each.before, each.leads[b]) for each, b in like],
        )


def _done(motions: Sequence[Motion], action: int) -> int | None:
    """The action that most of the motions look like that were to be `action`; None if they look like none.

    Where a wall is in front of the robot, or an action is to wait, poses that differ by noise alone would
    look like that action, so it is left out there.
    """
    like = Counter(
        next((b for b, way in _ways(each) if alike(each.found, way) and not alike(STILL, way)), None)
        for each in motions
        if each.action == action and abs(each.found[0]) + abs(each.found[1]) > TURNED
    )
    return like.most_common(1)[0][0] if like else None


def _ways(motion: Motion) -> Iterator[tuple[int, Move]]:
    """Each action, and the motion that it would have been."""
    return ((b, between(motion.before, to)) for b, to in enumerate(motion.leads))


def _middle(values: Iterable[float]) -> float:
    """The upper median. To import the library's takes a hundredth of a second."""
    ordered = sorted(values)
    return ordered[len(ordered) // 2]
