"""What a session has seen of its robot: every motion is compared with f, and weighed against what is known.

If the robot stands where it stood, or short of where a motion leads, that motion was not executed, or not all
of it. Any other gap between a pose and f is noise. The shield knows poses and its own draws, not what was
executed. So a robot that stands may have been told to, and counts by how likely that is.
"""

from __future__ import annotations

import math
import struct
from typing import NamedTuple

import numpy as np

from specshield.arrays import Floats, Ints
from specshield.caution.early import conjunction_of
from specshield.caution.noise import CHANCE, Care, Noise, margin_for
from specshield.compiled import kernel, leaf
from specshield.robot.body import centre
from specshield.robot.dynamics import TOUCH, Body, free_distance, unhindered, wrap
from specshield.shield.decision import Carry, Shield
from specshield.shield.uncertainty import Uncertainty
from specshield.stl.tree import EVENTUALLY
from specshield.task import Task, kept_with_task

ASSUMED = Uncertainty()
Told = tuple[float, float, float, bool]  # what `Uncertainty` says, and whether it is only assumed

# For how many motions that were seen each prior counts. Chosen by hand.
KNOWN_WEIGHT = 1000.0  # [motions] what the caller said of the robot
NOISE_WEIGHT, SLIP_WEIGHT = 20.0, 60.0  # [motions] what is assumed of a robot that nothing was said of
SLIPS_AT_ALL = 0.5  # the assumed probability that motions slip at all
EXACT = 1e-6  # [m], [rad] a motion that ends this near to where f leads shows no noise
SURE = 3  # [motions] after so many without noise, the assumed noise is dropped
STRAY = 0.25  # of a motion's length: one that misses its end by more, and by more than noise, was stopped
MOST_ODDS = 1e6  # a bound on `Seen.odds`, so that slips that begin late are still noticed
TINY = 1e-9  # [motions]
BESIDE = 0.2  # [m] the robot may meet obstacles this near: its footprint may be told wrong. By hand.
FAR = 5.0  # [sigma] the most that noise does: one motion in 270,000 ends farther off
SELDOM = 1e-3  # what slips alone would do less often than this has another cause. Chosen by hand.

FORMAT = struct.Struct("<9d")


class Seen(NamedTuple):
    """What a session remembers of its motions.

    moved: how many there were; lost: how many of them were not executed. Both may be fractions. odds: how
    likely what was seen is if motions never slip, divided by how likely it is if they do. noisy: how many
    were compared with f; moves, turns: the sums of their squared residuals [m^2], [rad^2]. exact: how many
    moves (not turns on the spot) had no residual. standing: the probability, by the last answer, that the
    robot was not told to move. slipping: the probability that slips alone make the robot stand as often in a
    row as it has now.
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

    contact: the last motion met something, or led on where f has it stopped, and does not count.
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
    """How far noise leads from where f does, at most [m], [rad]; None if the session does not learn that."""
    known = shield.config.uncertainty
    if known is None or carry.residuals is None:
        return None
    noise = noise_of(_told(known), Seen(*FORMAT.unpack(carry.residuals)))
    return EXACT + FAR * noise.move, EXACT + FAR * noise.turn


def was_stopped(shield: Shield, carry: Carry, poses: Floats, halts: int = 0) -> bool:
    """Whether a motion that ended short at x_t met something, since noise and slips do not explain it.

    halts: how often the same motion did nothing at this pose before.
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
    """The longest move [m], 1 if there is none; and how many deadlines the formula has, at least 1. A
    conjunct that is no F, such as a patrol, has one deadline for each longest window in it.
    """
    longest = max((abs(move) for move, _ in task.robot.motions), default=0.0)
    parts = conjunction_of(task, task.formula)[1].value
    half = np.maximum(parts.half, parts.lead)
    windows = (parts.b + parts.horizon) // np.maximum(2 * half, 1) * (half > 0)
    return longest or 1.0, max(int(np.where(parts.kind == EVENTUALLY, 1, windows).sum()), 1)


def remember(
    shield: Shield, seen: Seen, distribution: Floats, moved: int, nexts: Floats, pose: Floats
) -> bytes:
    """`seen` as bytes for the next decision. distribution [A]: what the robot will do, as far as that is
    known; moved: the action that it executes for a terminal one; nexts [M, 3]: where f leads from the pose.
    """
    standing = chance_of(shield.task.robot.motion_of, distribution, moved, nexts, pose)
    return FORMAT.pack(*seen[:7], standing, seen.slipping)


@kernel
def chance_of(motion_of: Ints, distribution: Floats, moved: int, nexts: Floats, pose: Floats) -> float:
    """The probability that the robot is led to a pose (3,). motion_of [A]; for the rest see `remember`."""
    total = 0.0
    for a in range(motion_of.shape[0]):
        m = motion_of[a] if motion_of[a] >= 0 else motion_of[moved]
        if distribution[a] > 0.0 and (m < 0 or _gap(nexts[m], pose) <= EXACT):
            total += distribution[a]
    return total


@leaf
def noise_of(told: Told, seen: Seen) -> Noise:
    """The noise by what was told and by what was seen, each weighted by the motions that it counts for."""
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
    """The motion that led on to `pose` though f has it stopped by an obstacle, so that the map or the
    footprint is told wrong; -1 for none. near: what noise explains [m], [rad]. For the rest see `observe`.
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
    """`seen` after one more step. before, pose (3,): x_{t-1}, x_t; foreseen [M, 3]: where f leads from
    x_{t-1}.
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
        # Either it was told to move and did not, or it was told to stand. How likely is each?
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
    """`observe`, and the noise after it. beside: whether steps beside obstacles do not count for slips."""
    found, near = observe(told, seen, before, foreseen, pose), body.radius + BESIDE
    u, v = centre(body, before[0], before[1], before[2])
    if beside and found.moved > seen.moved and near - free_distance(body, u, v, near) > TOUCH:
        # The obstacle may be why a motion was not executed there, so neither this nor success counts.
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
