"""What a step says of the map without any sensor: what a motion ran into, and where the robot has been.

The shield knows poses, not what was executed. A pose on the way of a motion, and short of where f leads, is a
contact of that motion, unless the end of another motion explains it. Where the robot did not move at all, it
may have slipped, or its caller may have chosen to wait: so that counts only for a caller that executes what
was drawn, beyond doubt (`Followed.surely`), and only the second time in a row.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from specshield.arrays import Bools, Floats, Ints
from specshield.caution.experience import BESIDE, SELDOM
from specshield.compiled import kernel
from specshield.portable import arctan2
from specshield.robot.body import centre
from specshield.robot.dynamics import TOUCH, Body, displacement, displacements, wrap
from specshield.world.learned import BEHIND, CONTACT, LEFT, RIGHT

Near = tuple[float, float]  # [m], [rad] poses this near may be one, but for noise
# For a robot of which nothing is known: five times the noise that SPOC's stochastic controller gives a
# Stretch (0.01 m, 0.5 degrees). Chosen by hand.
NEAR: Near = (0.05, math.radians(2.5))

ARC = math.radians(25.0)  # [rad] to both sides of straight ahead: where a contact is most likely. By hand.
ASIDE = math.radians(75.0)  # [rad] to both sides: where it may be. Chosen by hand.
THING = 0.3  # [m] how wide and deep an obstacle is taken to be that is on no map; chosen by hand
UNDER = 0.03  # [m] a cell that the footprint overlaps by more than this is free: three times the noise


class Followed(NamedTuple):
    """What is known of whether the caller executes what is drawn.

    drawn: the motion that was drawn last, -1 for none. follows: whether all steps so far fit what was drawn.
    halted: the drawn motion that did nothing in the step before, -1 for none. met: how many contacts there
    were at this very pose. by_chance: the probability that a caller who draws for itself seems to follow for
    so long. going, standing: the probabilities that it next goes where the drawn motion leads, and that it
    stays.
    """

    drawn: int = -1
    follows: bool = True
    halted: int = -1
    met: int = 0
    by_chance: float = 1.0
    going: float = 1.0
    standing: float = 0.0

    @property
    def surely(self) -> bool:
        """Whether it is beyond doubt that the caller executes what is drawn."""
        return self.follows and self.by_chance < SELDOM


def contact_of(
    body: Body, followed: Followed, before: Floats, after: Floats, foreseen: Floats, near: Near, again: bool
) -> tuple[int, Followed]:
    """The motion that stopped short between two poses (3,), -1 for none; and `followed` after this step.

    foreseen [M, 3]: where f leads from `before`. near: what noise explains. again: whether the drawn motion
    did nothing at this pose before.
    """
    drawn = followed.drawn
    stands = is_near(before[None], after, near)
    # Just before a wall of the map, f may foresee less of a motion than noise can be. If the robot does not
    # move there at all, something else stopped it, and it could push that until its time is up.
    if (
        drawn >= 0
        and is_near(foreseen[drawn : drawn + 1], after, near)
        and not (stands and _nearer(before, foreseen[drawn], after))
    ):
        return -1, moved_on(followed, as_drawn=True)
    if stands:
        followed = followed._replace(by_chance=followed.by_chance * followed.standing)
        if drawn < 0 or not followed.surely:
            return -1, followed._replace(halted=-1)
        if followed.halted == drawn or followed.met or again:  # something stopped it here already
            return drawn, followed._replace(halted=-1, met=followed.met + 1)
        return -1, followed._replace(halted=drawn)
    if is_near(foreseen, after, near):  # an arc that met something before its turn ends where a move does
        began = drawn >= 0 and is_near(np.append(foreseen[drawn, :2], before[2])[None], after, near)
        return -1, followed._replace(follows=followed.surely and began, halted=-1, met=0)
    short = _short(body, before, after, foreseen, near)
    if not short.any():
        return -1, moved_on(followed)
    motion = drawn if drawn >= 0 and short[drawn] else int(np.argmax(short))
    return motion, followed._replace(halted=-1, met=1)


def moved_on(followed: Followed, as_drawn: bool = False) -> Followed:
    """`followed` after a motion that met nothing. as_drawn: whether it was the one that was drawn."""
    if as_drawn and followed.by_chance >= SELDOM and followed.going < 1.0:
        followed = followed._replace(by_chance=followed.by_chance * followed.going)
    return followed._replace(halted=-1, met=0) if followed.halted >= 0 or followed.met else followed


@kernel
def is_near(poses: Floats, pose: Floats, near: Near) -> bool:
    """Whether one of poses [n, 3] is the pose (3,), but for noise."""
    for i in range(len(poses)):
        far = math.hypot(poses[i, 0] - pose[0], poses[i, 1] - pose[1])
        if far <= near[0] and abs(wrap(poses[i, 2] - pose[2])) <= near[1]:
            return True
    return False


def _nearer(one: Floats, other: Floats, pose: Floats) -> bool:
    """Whether a pose (3,) lies less than half as far from `one` (3,) as from `other` (3,)."""
    return bool(np.hypot(*(pose - one)[:2]) < 0.5 * np.hypot(*(pose - other)[:2]))


def _short(body: Body, before: Floats, after: Floats, foreseen: Floats, near: Near) -> Bools:
    """Which motions [M] lead straight through `after` and on."""
    cos, sin = math.cos(before[2]), math.sin(before[2])
    dx, dy = after[:2] - before[:2]
    ahead, aside = dx * cos + dy * sin, dy * cos - dx * sin
    straight = abs(aside) <= near[0] and abs(wrap(after[2] - before[2])) <= near[1]
    far, _ = displacements(body)
    reached = np.hypot(*(foreseen[:, :2] - before[:2]).T)
    return np.asarray(straight & (far * ahead > 0.0) & (abs(ahead) < reached - near[0]))


def cells_met(body: Body, pose: Floats, motion: int, driven: Floats) -> list[tuple[int, Ints]]:
    """The cells, ascending, of what a motion may have run into at a pose (3,), by where they lie.

    CONTACT, LEFT and RIGHT lie within a cell's side of the footprint: straight ahead of where its centre
    goes, which a turn swings, and to both sides of that. BEHIND is the rest of an obstacle of the usual size.
    Cells that the footprint overlapped at the poses driven [n, 3] are left out. A move of a robot that stays
    where it is may have met something anywhere along its way, so that is taken to be half way.
    """
    if not body.stop:
        half = 0.5 * displacement(body, motion)[0]
        pose = pose + np.array([half * math.cos(pose[2]), half * math.sin(pose[2]), 0.0])
    cells, gap, bearing = _around(body, pose, THING)
    aside = np.remainder(bearing - _direction(body, pose, motion) + math.pi, 2.0 * math.pi) - math.pi
    far = gap + body.radius
    x, y = far * np.cos(aside), far * np.sin(aside)
    rim = (gap > -TOUCH) & (gap <= body.resolution)
    thing = np.hypot(x - body.radius - 0.5 * THING, y) <= 0.5 * THING
    parts = (
        (BEHIND, thing & ~rim),
        (LEFT, rim & (aside > ARC) & (aside <= ASIDE)),
        (RIGHT, rim & (aside < -ARC) & (aside >= -ASIDE)),
        (CONTACT, rim & (np.abs(aside) <= ARC)),
    )
    clear = _gaps(body, cells, driven) < -UNDER
    return [(by, cells[part & ~clear]) for by, part in parts]


def lies_beside(body: Body, cells: Ints, pose: Floats, motion: int) -> bool:
    """Whether one of the cells [n] is beside the footprint at a pose (3,), or where a motion leads it."""
    if motion < 0 or not len(cells):
        return False
    far, (x, y, theta) = displacement(body, motion)[0], pose
    ends = np.array([pose, (x + far * math.cos(theta), y + far * math.sin(theta), theta)])
    return bool(_gaps(body, cells, ends).min() <= BESIDE)


def _direction(body: Body, pose: Floats, motion: int) -> float:
    """Where the footprint's centre goes [rad]."""
    far, turn = displacement(body, motion)
    if far == 0.0:
        return float(pose[2] + math.atan2(body.offset_y, body.offset_x) + math.copysign(0.5 * math.pi, turn))
    return float(pose[2]) + (0.0 if far > 0.0 else math.pi)


def cells_under(body: Body, pose: Floats, deep: float) -> Ints:
    """The cells, ascending, that the footprint at a pose (3,) covers by more than `deep` [m]."""
    cells, gap, _ = _around(body, pose, 0.0)
    return np.asarray(cells[gap < -deep])


def _around(body: Body, pose: Floats, beyond: float) -> tuple[Ints, Floats, Floats]:
    """The cells within `beyond` [m] of the footprint, how far they are from it [m], and where [rad]."""
    h, (u, v) = body.resolution, centre(body, *pose)
    reach = body.radius + beyond + h
    height, width = body.occupied.shape
    rows, columns = (
        np.arange(*np.clip(((at - reach) / h, (at + reach) / h + 1.0), 0, side).astype(int))
        for at, side in ((v, height), (u, width))
    )
    row, column = (each.ravel() for each in np.meshgrid(rows, columns, indexing="ij"))
    cells = row * width + column
    yaw = math.atan2(body.sin_yaw, body.cos_yaw)
    bearing = arctan2((row + 0.5) * h - v, (column + 0.5) * h - u) + yaw
    return cells, _gaps(body, cells, pose[None]), bearing


@kernel
def _gaps(body: Body, cells: Ints, poses: Floats) -> Floats:
    """How far each cell [n] is from the footprint at the nearest of poses [m, 3]; below 0: overlapped."""
    h, width = body.resolution, body.occupied.shape[1]
    gap = np.full(cells.shape[0], np.inf)
    for pose in poses:
        u, v = centre(body, pose[0], pose[1], pose[2])
        for i in range(cells.shape[0]):
            row, column = cells[i] // width, cells[i] % width
            du = max(max(column * h - u, u - (column + 1) * h), 0.0)
            dv = max(max(row * h - v, v - (row + 1) * h), 0.0)
            gap[i] = min(gap[i], math.hypot(du, dv) - body.radius)
    return gap
