"""What a session has seen of its robot: every motion is compared with f, and weighed against what is known.

A pose that is on the way of a motion and short of its end, or where the robot stood, is a motion that was not
executed, or not all of it; any other gap between a pose and f is noise. The shield knows poses and its own
draws, not what was executed: a robot that stands may have been told to, and counts by how likely that is.
"""

from __future__ import annotations

import math
import struct
from typing import NamedTuple

import numpy as np

from specshield.arrays import Floats, Ints
from specshield.compiled import kernel, leaf
from specshield.robot.body import centre
from specshield.robot.dynamics import TOUCH, Body, free_distance, unhindered, wrap
from specshield.rule.early import conjunction_of
from specshield.shield.decision import Carry, Shield
from specshield.shield.uncertainty import CHANCE, Care, Noise, Uncertainty, margin_for
from specshield.stl.tree import EVENTUALLY
from specshield.task import Task, kept_with_task

ASSUMED = Uncertainty()
Told = tuple[float, float, float, bool]  # what `Uncertainty` says, and whether it is only assumed

# How much what is taken before the first step weighs. Chosen by hand.
KNOWN_WEIGHT = 1000.0  # [motions] what was said of the robot
NOISE_WEIGHT, SLIP_WEIGHT = 20.0, 60.0  # [motions] what is assumed of it
SLIPS_AT_ALL = 0.5  # the assumed probability that motions slip, before the first
EXACT = 1e-6  # [m] and [rad]: what ends this near to where f has it shows no noise
SURE = 3  # [motions] that have shown none, after which there is none but for what is seen
STRAY = 0.25  # of a motion's length: what misses by more, and by more than noise, was stopped
MOST_ODDS = 1e6  # so that what changes late is still noticed
TINY = 1e-9  # [motions]
BESIDE = 0.2  # [m] from the footprint, which may be told wrong: what is so near may be met. By hand.
FAR = 5.0  # [sigma] what noise does: one motion in 270,000 ends farther off
SELDOM = 1e-3  # what slips alone do not do so often is done by something else; chosen by hand

FORMAT = struct.Struct("<9d")


class Seen(NamedTuple):
    """What a session remembers of its motions.

    moved: how many there were, and lost: how many of them were not executed; both may be fractions. odds: of
    what was seen if motions never slip, to if they do. noisy: how many were measured against f; moves, turns:
    the sums of their squared residuals [m^2], [rad^2]; exact: how many had none, of those that do not turn on
    the spot, which says nothing of a stride. standing: the probability, by the last answer, that the robot is
    not told to move. slipping: how likely it was to stand, by slips alone, as often in a row as it has now.
    """

    moved: float = 0.0
    lost: float = 0.0
    odds: float = 1.0
    noisy: float = 0.0
    moves: float = 0.0
    turns: float = 0.0
    exact: float = 0.0
    standing: float = 0.0
    slipping: float = 1.0


def learn(
    shield: Shield, carry: Carry | None, poses: Floats, contact: bool = False
) -> tuple[Seen | None, Care]:
    """What has been seen up to x_t, and what J asks for because of it. poses [t + 1, 3].

    contact: the last motion ran into something, or on through it, and says nothing of how the robot moves.
    """
    config, t, known = shield.config, len(poses) - 1, shield.config.uncertainty
    if known is None:
        return None, Care(config.margin, config.slack)
    told = _told(known)
    seen = Seen() if carry is None or carry.residuals is None else Seen(*FORMAT.unpack(carry.residuals))
    if carry is not None and carry.t == t - 1 and not contact:
        nexts = carry.next_poses
        seen, noise = _weighed(shield.body, config.learn_map, told, seen, poses[-2], nexts, poses[-1])
    else:
        noise = noise_of(told, seen)
    stride, deadlines = _measures(shield.task)
    margin = margin_for(noise, stride, shield.task.horizon - t)
    return seen, Care(max(config.margin, margin), config.slack, noise, stride, 0.5 * CHANCE / deadlines)


def _told(known: Uncertainty) -> Told:
    return known.translation, known.rotation, known.slip, known == ASSUMED


def within_noise(shield: Shield, carry: Carry) -> tuple[float, float] | None:
    """How far [m], [rad] noise leads at most from where f does; None where nothing is learned of it."""
    known = shield.config.uncertainty
    if known is None or carry.residuals is None:
        return None
    noise = noise_of(_told(known), Seen(*FORMAT.unpack(carry.residuals)))
    return EXACT + FAR * noise.move, EXACT + FAR * noise.turn


def was_stopped(shield: Shield, carry: Carry, poses: Floats, halts: int = 0) -> bool:
    """Whether a motion that ended short at x_t met something: noise and slips do not explain it.

    halts: how often it did nothing at this pose before.
    """
    known = shield.config.uncertainty
    if known is None or carry.residuals is None:
        return True
    before, pose, seen = poses[-2], poses[-1], Seen(*FORMAT.unpack(carry.residuals))
    noise, still = noise_of(_told(known), seen), _gap(before, pose)
    far = EXACT + FAR * (noise.move + noise.turn)
    miss = min((_gap(end, pose) for end in carry.next_poses if _gap(end, before) > EXACT), default=math.inf)
    if still < miss and still <= far:
        return min(seen.slipping * _slip(noise), _slip(noise) ** (halts + 1)) < SELDOM
    return miss > far


@kept_with_task
def _measures(task: Task) -> tuple[float, int]:
    """The longest move [m], and how many deadlines the formula has, both at least 1 where there is none. What
    is no F has one in each longest window, as a patrol does.
    """
    longest = max((abs(move) for move, _ in task.robot.motions), default=0.0)
    parts = conjunction_of(task, task.formula)[1]
    half = np.maximum(parts.half, parts.lead)
    windows = (parts.b + parts.horizon) // np.maximum(2 * half, 1) * (half > 0)
    return longest or 1.0, max(int(np.where(parts.kind == EVENTUALLY, 1, windows).sum()), 1)


def remember(
    shield: Shield, seen: Seen, distribution: Floats, moved: int, nexts: Floats, pose: Floats
) -> bytes:
    """What is handed on. distribution [A]: of what the robot does, as far as that is known; moved: what is
    executed for a terminal action; nexts [M, 3]: where f leads from the pose (3,).
    """
    motion_of = shield.task.robot.motion_of
    return FORMAT.pack(*seen._replace(standing=chance_of(motion_of, distribution, moved, nexts, pose)))


@kernel
def chance_of(motion_of: Ints, distribution: Floats, moved: int, nexts: Floats, pose: Floats) -> float:
    """The probability that what is done leads to a pose (3,); motion_of [A], the rest is as in `remember`."""
    total = 0.0
    for a in range(motion_of.shape[0]):
        m = motion_of[a] if motion_of[a] >= 0 else motion_of[moved]
        if distribution[a] > 0.0 and (m < 0 or _gap(nexts[m], pose) <= EXACT):
            total += distribution[a]
    return total


@leaf
def noise_of(told: Told, seen: Seen) -> Noise:
    """The means of what was told, as in `Uncertainty`, and of what was seen, each by how many motions it
    stands for.
    """
    translation, rotation, slip, assumed = told
    weight, weight_of_slip, at_all = KNOWN_WEIGHT, KNOWN_WEIGHT, 1.0
    if assumed:
        weight, weight_of_slip, at_all = NOISE_WEIGHT, SLIP_WEIGHT, SLIPS_AT_ALL
        if seen.exact >= SURE:
            weight = 0.0
    count = max(weight + seen.noisy, 1.0)
    slips = at_all / (at_all + (1.0 - at_all) * seen.odds)
    return Noise(
        math.sqrt((weight * translation**2 + 0.5 * seen.moves) / count),  # along two axes
        math.sqrt((weight * rotation**2 + seen.turns) / count),
        slips if slip > 0.0 or seen.lost > 0.0 else 0.0,
        max(weight_of_slip * slip + seen.lost, TINY),
        max(weight_of_slip * (1.0 - slip) + seen.moved - seen.lost, TINY),
    )


@kernel
def went_on(body: Body, before: Floats, foreseen: Floats, pose: Floats, near: tuple[float, float]) -> int:
    """The motion that led farther than f, which has it run into something, so that the map or the footprint
    is not as told; -1 where none did. near [m], [rad]: what noise explains; the others are as in `observe`.
    """
    led, closest, (x, y, theta) = -1, np.inf, before
    for m in range(foreseen.shape[0]):
        if _gap(foreseen[m], pose) <= near[0] + near[1]:
            return -1
        free = np.array(unhindered(body, x, y, theta, math.cos(theta), math.sin(theta), m))
        gap = _gap(free, pose)
        if gap < _gap(free, foreseen[m]) - EXACT and gap < closest:
            led, closest = m, gap
    return led


@kernel
def observe(told: Told, seen: Seen, before: Floats, foreseen: Floats, pose: Floats) -> Seen:
    """Takes one step into what is remembered. before, pose (3,): x_{t-1} and x_t; foreseen [M, 3]: where f
    leads from x_{t-1}.
    """
    miss, way, motion = np.inf, 0.0, -1
    for m in range(foreseen.shape[0]):
        length = _gap(foreseen[m], before)
        if length > EXACT and _gap(foreseen[m], pose) < miss:
            miss, way, motion = _gap(foreseen[m], pose), length, m
    if motion < 0:  # f leads nowhere from there
        return seen
    noise, still = noise_of(told, seen), _gap(before, pose)
    far = FAR * (noise.move + noise.turn)
    if still < miss or miss > max(STRAY * way, far):
        # It was to move and did not, or it was to stand: how likely is either?
        rate = noise.lost / (noise.lost + noise.kept)
        standing = seen.standing if still <= EXACT + far else 0.0
        asked = (1.0 - standing) * rate
        slipped = noise.slips * asked / (noise.slips * asked + standing) if standing > 0.0 else 1.0
        odds = seen.odds * standing / (standing + asked)
        lost = seen.lost + slipped * min(1.0, miss / way)
        slipping = seen.slipping * _slip(noise) if still < miss else 1.0
        return Seen(seen.moved + slipped, lost, odds, *seen[3:8], slipping)
    gone = math.hypot(foreseen[motion, 0] - before[0], foreseen[motion, 1] - before[1])
    dx, dy = pose[0] - foreseen[motion, 0], pose[1] - foreseen[motion, 1]
    return Seen(
        seen.moved + 1.0,
        seen.lost,
        min(seen.odds * (1.0 + noise.lost / noise.kept), MOST_ODDS),
        seen.noisy + 1.0,
        seen.moves + dx * dx + dy * dy,
        seen.turns + wrap(pose[2] - foreseen[motion, 2]) ** 2,
        seen.exact + (1.0 if miss <= EXACT and gone > EXACT else 0.0),
        seen.standing,
        1.0,
    )


@kernel
def _weighed(
    body: Body, beside: bool, told: Told, seen: Seen, before: Floats, foreseen: Floats, pose: Floats
) -> tuple[Seen, Noise]:
    """`observe`, and the noise by it. beside: whether the robot may have met what it stands beside."""
    found, near = observe(told, seen, before, foreseen, pose), body.radius + BESIDE
    u, v = centre(body, before[0], before[1], before[2])
    if beside and found.moved > seen.moved and near - free_distance(body, u, v, near) > TOUCH:
        # There, neither what failed nor what worked counts.
        found = Seen(seen.moved, seen.lost, seen.odds, *found[3:])
    return found, noise_of(told, found)


@leaf
def _slip(noise: Noise) -> float:
    """The probability that the next motion is not executed."""
    return noise.slips * noise.lost / (noise.lost + noise.kept)


@leaf
def _gap(one: Floats, other: Floats) -> float:
    """How far two poses (3,) are apart: metres and radians, added up."""
    return math.hypot(one[0] - other[0], one[1] - other[1]) + abs(wrap(one[2] - other[2]))
