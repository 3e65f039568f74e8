"""The shield on a session's own map: what the session learns of it, decision by decision.

A decision certifies on the map as it is known after what it has just learned itself. Policies that have
`on_body` propose on that map too, whatever map their tables were made for.
"""

from __future__ import annotations

import math
import struct
from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from threading import Lock
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from specshield.arrays import Bools, Floats
from specshield.caution.experience import SELDOM, chance_of, was_stopped, went_on, within_noise
from specshield.caution.noise import Care
from specshield.caution.surprise.barred import NOTHING_BARRED, is_barred
from specshield.caution.surprise.contact import (
    NEAR,
    UNDER,
    Followed,
    Near,
    cells_met,
    cells_under,
    contact_of,
    is_near,
    lies_beside,
    moved_on,
)
from specshield.caution.surprise.vain import barred_by, did_nothing, halts_at, led_nowhere, worked
from specshield.compiled import leaf
from specshield.robot.dynamics import (
    Body,
    displacement,
    displacements,
    longest_motions,
    make_body,
    overlap,
    successors,
    wrap,
)
from specshield.shield.decision import Carry, Shield, Stuck
from specshield.shield.feasibility import Prefix
from specshield.shield.proposal import adapted
from specshield.world.learned import (
    BEHIND,
    CONTACT,
    NONE,
    SENT,
    LearnedMap,
    applied,
    cells_of,
    check_points,
    forget,
    learn,
    revised,
)

# What a way around an obstacle takes that only contacts show, by hand (docs/decisions.md): 20 steps, or what
# 2 m and 300 degrees take. A robot that has to turn round gets up to 20 steps more: of 30 runs a
# locobot kept 28 with them, and 22 without.
AROUND, AROUND_FAR, AROUND_TURNED = 20, 2.0, math.radians(300.0)
NEARBY = 2.0  # [m] poses farther away than this say nothing of an obstacle that was run into
SAME_PLACE = 1e-6  # [m] poses this near differ by rounding alone
KEPT = 64  # bodies on learned maps in a process: 0.4 MB each in a flat of 10 x 10 m at 5 cm
HEAD = struct.Struct("<h?hB3f")  # the fields of `Followed`
MOST_MET = 255  # contacts at one pose that HEAD can hold


class Taught(NamedTuple):
    """What a session has learned: its map, and whether its caller executes what is drawn.

    contact: whether the last motion ran into something, or went on where f has it stopped. looks: whether
    `occupied` was sent at this step, be it empty. near [m], [rad]: two poses this near to each other may
    differ by noise alone. These three are not handed on.

    stuck: motions that led nowhere, or elsewhere than f has it, and from where. here: the first step at which
    this robot was on this map. `Carry` holds these two beside the bytes.
    """

    map: LearnedMap = NONE
    followed: Followed = Followed()
    contact: bool = False
    stuck: tuple[Stuck, ...] = ()
    near: Near = NEAR
    here: int = 0
    looks: bool = False

    @property
    def barred(self) -> Floats:
        """[n, 6]: the motions that futures avoid as long as one without them keeps the rule."""
        return barred_by(self.stuck, self.near) if self.stuck else NOTHING_BARRED

    def to_bytes(self) -> bytes:
        known = self.followed
        return HEAD.pack(*known[:3], min(known.met, MOST_MET), *known[4:]) + self.map.to_bytes()

    @staticmethod
    def from_bytes(value: bytes | None) -> Taught:
        if value is None:
            return Taught()
        return Taught(LearnedMap.from_bytes(value[HEAD.size :]), Followed(*HEAD.unpack_from(value)))


def teach(
    shield: Shield, carry: Carry | None, poses: Floats, occupied: ArrayLike | None, free: ArrayLike | None
) -> tuple[Taught, tuple[str, ...]]:
    """What the session knows at step t = len(poses) - 1, and warnings about the points that were sent.

    carry: what the last decision handed on. occupied, free [n, 2]: points that sensors see [m]. Raises
    SampleError for points that are not such a list.
    """
    grid, config, t = shield.task.grid, shield.config, len(poses) - 1
    learned, stuck, here = (None, (), 0) if carry is None else (carry.learned, carry.stuck, carry.here)
    if learned is None and occupied is None and free is None and not config.learn_map:
        return Taught(here=here), ()
    before = Taught.from_bytes(learned)
    known, followed, motion, on, near = before.map, before.followed, -1, -1, NEAR
    if config.map_memory is not None:
        known = forget(known, known.occupied & (t - known.step > config.map_memory))
    if config.learn_map and carry is not None and carry.t == t - 1:
        told = known is NONE and occupied is None and free is None and not stuck and followed.drawn >= 0
        told = told and is_near(carry.next_poses[followed.drawn, None], poses[-1], (SAME_PLACE, SAME_PLACE))
        if told and not any(_covers(shield.body, poses[-2], poses[-1], np.empty(3))):
            return Taught(followed=moved_on(followed, as_drawn=True), here=here), ()
        body, near = body_on(shield, before.map), within_noise(shield, carry) or NEAR
        drawn, came_back = followed.drawn, t > 1 and not is_near(poses[-3:-2], poses[-2], near)
        halts = halts_at(stuck, poses[-1], drawn, near)
        felt = known.cell[known.occupied & (known.by != SENT)]
        beside = is_near(poses[-2:-1], poses[-1], near) and lies_beside(body, felt, poses[-1], drawn)
        again = beside or halts > 0
        motion, followed = contact_of(body, followed, poses[-2], poses[-1], carry.next_poses, near, again)
        if motion >= 0 and followed.met < 2 and not (beside or was_stopped(shield, carry, poses, halts)):
            motion, followed = -1, followed._replace(halted=motion, met=0)
        if motion < 0 and not (drawn >= 0 and is_near(carry.next_poses[drawn : drawn + 1], poses[-1], near)):
            on = went_on(body, poses[-2], carry.next_poses, poses[-1], near)
        if motion >= 0 or (halts > 0 and came_back and followed.halted == drawn):
            # Slips come in a row; what does nothing, and again once the robot is back, did not slip.
            stuck = led_nowhere(stuck, poses[-1], max(motion, followed.halted), near)
        elif followed.halted >= 0 and followed is not before.followed:
            stuck = did_nothing(stuck, poses[-1], followed.halted)
        elif on >= 0:  # f was wrong there: a way that relies on it again may lead round in a circle
            stuck = led_nowhere(stuck, poses[-2], on, near)
        elif drawn >= 0 and not is_near(poses[-2:-1], poses[-1], near):
            stuck = worked(stuck, poses[-2], drawn, near)
        half_way = np.empty(3)
        covers = _covers(body, poses[-2], poses[-1], half_way)
        for pose, deep in zip((half_way, poses[-1]), covers, strict=True):
            if deep:
                known = learn(grid, known, t, cells_under(body, pose, UNDER), False, CONTACT)
        if motion >= 0:
            driven = poses[here:][np.hypot(*(poses[here:, :2] - poses[-1, :2]).T) <= NEARBY]
            met = cells_met(body, poses[-1], motion, driven)
            if not any(len(cells) for _, cells in met):  # a wrong footprint, or something that moved there
                met = cells_met(body, poses[-1], motion, poses[-1:])
            for by, cells in met:
                # Cells along the front were touched, so they replace guesses. A guess replaces nothing.
                kept = known.cell if by == BEHIND else known.cell[known.by != BEHIND]
                known = learn(grid, known, t, np.setdiff1d(cells, kept), True, by)
    beyond, said = 0, list[str]()
    for name, points in (("free", free), ("occupied", occupied)):  # a cell sent as both is occupied
        if points is not None:
            cells, outside = cells_of(grid, check_points(points, name))
            if name == "occupied":
                seen, cells = cells, np.setdiff1d(cells, cells_under(shield.body, poses[-1], UNDER))
                if len(cells) < len(seen):
                    said.append("`occupied` points under the robot were ignored: it stands there")
            known = learn(grid, known, t, cells, name == "occupied")
            beyond += outside
    if beyond:
        said.append(f"{beyond} points lie outside the map and were ignored")
    own = known if known is before.map else revised(before.map, known)
    return Taught(own, followed, motion >= 0 or on >= 0, stuck, near, here, occupied is not None), tuple(said)


@leaf
def _covers(body: Body, before: Floats, after: Floats, half_way: Floats) -> tuple[bool, bool]:
    """Whether the footprint overlaps obstacles by more than UNDER half way between two poses (3,), and at the
    second. Writes the pose half way, before the motion's turn, into half_way (3,). If no motion leads as far,
    the robot was carried, or only its localisation moved: nothing is known of the way between.
    """
    half_way[0], half_way[1] = 0.5 * (before[0] + after[0]), 0.5 * (before[1] + after[1])
    half_way[2] = before[2]
    far, _ = longest_motions(body)
    half = math.hypot(after[0] - before[0], after[1] - before[1]) <= far + NEAR[0]
    half = half and overlap(body, half_way[0], half_way[1], half_way[2]) > UNDER
    return half, overlap(body, after[0], after[1], after[2]) > UNDER


def wary(shield: Shield, care: Care, taught: Taught, on_way: bool) -> Care:
    """`care`, and what J asks for because the map may be wrong: time for a way around, room beside it, and
    none of the motions that led nowhere. on_way: see `Care`.
    """
    config, room, unsure = shield.config, False, shield.config.uncertainty is not None
    least, barred = care.least, taught.barred if config.learn_map and len(taught.barred) else None
    if config.learn_map and unsure:
        room = not shield.task.robot.goes_back
        far, turn = (longest or math.inf for longest in longest_motions(shield.body))
        around = max(AROUND, math.ceil(AROUND_FAR / far + AROUND_TURNED / turn - 1e-9))
        least = max(least, around + (min(2 * math.ceil(math.pi / turn - 1e-9), AROUND) if room else 0))
    return Care(care.margin, least, *care[2:5], barred, on_way and unsure, room)


def doubtful(
    told: Shield, taught: Taught, prefix: Prefix, nexts: Floats, left_out: Bools
) -> tuple[Bools, Bools]:
    """The motions [M] that had better not be drawn, and which of them may break the prefix's formula [M].

    The first are: those that end elsewhere if contacts are not believed, since what only a contact marks may
    not be there; those that an obstacle stops short and that would break the formula if it stood a little
    farther away; those that led nowhere before; and `left_out` [M]. The second are the second of these kinds.

    told: the shield on the policy's map. nexts [M, 3]: where f leads from x_t on the session's own map.
    """
    known, motions, pose = taught.map, len(nexts), prefix.poses[-1]
    doubts, risky, config = left_out.copy(), np.zeros(motions, np.bool_), told.config
    if len(known) and (marks := known.occupied & (known.by != SENT)).any():
        ends = np.empty((2, motions, 3))
        for end, believed in zip(ends, (known, forget(known, marks)), strict=True):
            successors(body_on(told, believed), pose, end)
        doubts |= np.any(ends[0] != ends[1], axis=1)
    stopped = np.zeros(motions, np.bool_)
    if config.learn_map and (config.uncertainty is not None or len(known)):
        _stop_short(*displacements(told.body), pose, nexts, stopped)
        for motion in [m for m, short in enumerate(stopped.tolist()) if short]:
            places = _farther(told.body, pose, motion, nexts[motion])
            risky[motion] = any(not prefix.allows(place) for place in places)
            doubts[motion] |= risky[motion]
    if len(barred := taught.barred):
        doubts |= [is_barred(barred, pose[0], pose[1], pose[2], motion) for motion in range(motions)]
    return doubts, risky


@leaf
def _stop_short(far: Floats, turn: Floats, pose: Floats, nexts: Floats, stopped: Bools) -> None:
    """Writes into stopped (M,) which motions end short of their displacement from a pose (3,). far [m], turn
    [rad] (M,): the displacements; nexts (M, 3): where f leads.
    """
    for m in range(nexts.shape[0]):
        gone = math.hypot(nexts[m, 0] - pose[0], nexts[m, 1] - pose[1])
        short = abs(gone - abs(far[m])) > SAME_PLACE
        stopped[m] = short or (turn[m] != 0.0 and nexts[m, 2] == pose[2])


def _farther(body: Body, pose: Floats, motion: int, end: Floats) -> Iterator[Floats]:
    """Where a motion from a pose (3,) may lead if the obstacle that stops it at `end` (3,) stands farther
    away: a pose at least every cell's side, and the pose that it leads to if nothing stops it.
    """
    (far, turn), (x, y, theta) = displacement(body, motion), pose
    goes_on = far - math.copysign(math.hypot(end[0] - x, end[1] - y), far)
    for more in np.linspace(0.0, goes_on, math.ceil(abs(goes_on) / body.resolution) + 1)[1:-1]:
        yield np.array([end[0] + more * math.cos(theta), end[1] + more * math.sin(theta), theta])
    yield np.array([x + far * math.cos(theta), y + far * math.sin(theta), wrap(theta + turn)])


def on_map(shield: Shield, known: LearnedMap, guess: bool = False, barred: Floats | None = None) -> Shield:
    """The shield on a session's own map. guess: whether it is one of several that a decision tries.

    barred [n, 6]: motions without which its policies are to find ways (caution/surprise/barred.py).
    """
    body, proposers = body_on(shield, known), shield.proposers
    if len(known):
        proposers = tuple(adapted(p, "on_body", body, guess) for p in proposers)
    if barred is not None and len(barred):
        proposers = tuple(adapted(p, "avoiding", barred) for p in proposers)
    return shield if proposers is shield.proposers else replace(shield, body=body, proposers=proposers)


def handed_on(
    shield: Shield, taught: Taught, moved: int, distribution: Floats, nexts: Floats, pose: Floats
) -> bytes | None:
    """`taught` as bytes for the next decision; None if nothing was learned and the session learns nothing by
    itself. For the arguments see `remember`.
    """
    if not shield.config.learn_map and not taught.map.revision:
        return None
    drawn = int(shield.task.robot.motion_of[moved])  # -1 for a terminal action
    followed = Followed(drawn, *taught.followed[1:])
    if followed.follows and followed.by_chance >= SELDOM:
        chance = partial(chance_of, shield.task.robot.motion_of, distribution, moved, nexts)
        going, standing = chance(nexts[drawn] if drawn >= 0 else pose), chance(pose)
        followed = followed._replace(going=going, standing=standing)
    return Taught(taught.map, followed).to_bytes()


_bodies: OrderedDict[tuple[str, bytes], Body] = OrderedDict()
_lock = Lock()


def body_on(shield: Shield, known: LearnedMap) -> Body:
    """The robot on a session's own map, made once for each map in this process."""
    if not len(known):
        return shield.body
    key = shield.task.content_hash, known.digest
    with _lock:
        body = _bodies.get(key)
        if body is not None:
            _bodies.move_to_end(key)
            return body
    body = make_body(shield.task.robot, applied(shield.task.grid, known))
    with _lock:
        _bodies[key] = body
        while len(_bodies) > KEPT:
            _bodies.popitem(last=False)
    return body
