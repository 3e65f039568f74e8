"""If what was seen or touched leaves no way, what of it is doubted; and what is done if no way is left."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from specshield.arrays import Bools, Ints
from specshield.caution.escape import spread
from specshield.caution.judgement import Judged, Situation
from specshield.caution.signals import judged_by_signals
from specshield.caution.surprise.contact import cells_under
from specshield.caution.surprise.recovery import most_kept, recovers
from specshield.caution.taught import AROUND, Taught, body_on, on_map
from specshield.robot.dynamics import overlap, step
from specshield.shield.decision import Shield
from specshield.shield.feasibility import Futures, Prefix, futures, together
from specshield.shield.proposal import adapted
from specshield.stl import Formula
from specshield.world.learned import BEHIND, CONTACT, LEFT, RIGHT, SENT, forget, learn, revised

GUESSES = ((CONTACT, LEFT, RIGHT), (CONTACT,), (LEFT,), (RIGHT,))  # what of a contact is believed, in turn
BESIDE_WALLS = 0.1  # [m] from the map's own obstacles; what is nearer may be a part of them. Chosen by hand
AGAIN = 0.2  # [m] from what was touched before; what is nearer may be the same thing. Chosen by hand
SKIN = 0.05  # [m] from the footprint; what is seen nearer, all around, is the robot itself; chosen by hand
DOUBTED_AFTER = 4  # [steps] after which a contact is doubted if nothing else is left; chosen by hand
UNSEEN_AFTER = 20  # [steps] the same, for cells that were sent as occupied and not again; chosen by hand
MOST_PARTS = 4  # parts of the rule, which no way keeps together, that are tried one by one; chosen by hand


def tried_again(
    told: Shield, taught: Taught, judged: Judged, now: Situation
) -> tuple[Taught, tuple[Shield, Situation, Judged, bool]] | None:
    """The first guess about the map that leaves a way without motions that led nowhere before, and how the
    actions were judged by it. If there is none and the map as marked leaves no such way either, the map as
    marked if it leaves one with such motions, else the first guess that does. None if no guess is needed, or
    none leaves a way.

    told: the shield on the policy's map; judged: by the map as marked.
    """
    if judged.some and not judged.vain:
        return None
    vain, now = None, now._replace(care=now.care._replace(guess=True))
    for guess in doubted(told, taught, now.prefix):
        found = judged_by_signals(on_map(told, guess.map, True, taught.barred), now)
        if found[2].some and not found[2].vain:
            return guess, found
        if found[2].some and vain is None and not judged.some:
            vain = guess, found
    if not judged.some and len(taught.barred):
        found = judged_by_signals(on_map(told, taught.map), now)
        if found[2].some:
            return taught, found
    return vain


def doubted(told: Shield, taught: Taught, prefix: Prefix) -> Iterator[Taught]:
    """What may be believed of the map if no way is left, in the order in which it is to be tried.

    What a sensor sees all around the footprint is the robot itself. A motion that stopped short met
    something, but nobody knows where along its front, nor how large it is. So less is believed than is
    marked: nothing behind what was touched; of the last contact only what lies beside what was touched
    before, which may be a little larger; only what lies beside the map's own obstacles, which may stand a
    little elsewhere; only what lies straight ahead; only what lies to the left; only what lies to the right.
    Each new contact at the same pose shows that the guess before was wrong, so the next one is tried first.
    Then contacts of DOUBTED_AFTER steps ago or earlier are forgotten, since no contact shows that an obstacle
    is gone; then cells that no sensor saw again for UNSEEN_AFTER steps. At last, all just passed is free.
    """
    known, t, body, sent = taught.map, prefix.t, body_on(told, taught.map), taught.map.by == SENT
    marked, beside = known.occupied & ~sent, told.task.grid.clearance.ravel()[known.cell] <= BESIDE_WALLS
    held = [marked & np.isin(known.by, some) for some in GUESSES]
    held.insert(1, marked & beside & (known.by != BEHIND))
    newest = marked & (known.step == known.step[marked].max(initial=-1))
    same, front = np.zeros_like(newest), np.flatnonzero(newest & (known.by != BEHIND))
    same[front] = _is_near(told, known.cell[front], known.cell[marked & ~newest])
    if same.any():
        held.insert(1, (marked & ~newest) | same)
    first = max(taught.followed.met - 1, 0) % len(held)
    old = known.occupied & (t - known.step >= np.where(sent, UNSEEN_AFTER, DOUBTED_AFTER))
    unseen = told.config.learn_map and taught.looks and (old & sent).any()
    # A ring around the robot is the robot itself; a thing beside it lies in fewer eighths of a circle.
    around = cells_under(body, prefix.poses[-1], -SKIN)
    dy, dx = (each - each.sum() / max(len(around), 1) for each in np.divmod(around, told.task.grid.width))
    eighth = 4 * (dy > 0) + 2 * (dx > 0) + (np.abs(dy) > np.abs(dx))
    seen = np.isin(around, known.cell[known.occupied & sent])
    itself = np.isin(known.cell, around[seen]) & (len(np.unique(eighth[seen])) == 8)
    less = [marked & ~some for some in held[first:] + held[:first] if some.any()]
    for gone in [itself, *less, old & marked, *([old] if unseen else [])]:
        if gone.any():
            yield taught._replace(map=revised(known, forget(known, gone | itself)))
    if told.config.learn_map:
        recent = prefix.poses[max(t - DOUBTED_AFTER, taught.here) :]
        under = [cells_under(body, pose, 0.0) for pose in recent if overlap(body, *pose) > 0.0]
        passed = np.setdiff1d(np.concatenate([known.cell, *under]), known.cell)  # what was learned stays
        free = learn(told.task.grid, known, t, passed, False, CONTACT)
        if len(free) > len(known):
            yield taught._replace(map=revised(known, free))


def _is_near(told: Shield, cells: Ints, others: Ints) -> Bools:
    """Which cells [n] lie within AGAIN of one of the others [m]."""
    (y, x), (v, u) = (np.divmod(each, told.task.grid.width) for each in (cells, others))
    apart = np.hypot(x[:, None] - u, y[:, None] - v).min(axis=1, initial=np.inf)
    return np.asarray(apart * told.task.grid.resolution <= AGAIN)


def recovered(told: Shield, shield: Shield, taught: Taught, judged: Judged, now: Situation) -> Judged:
    """If no motion is feasible, `judged` with the action that keeps most of the rule as its completion, and
    warnings that say what that gives up.

    If the obstacles in the way may go again, the robot waits for that, as long as it gives up no more by
    waiting. If no future comes nearer to the first part that is lost than the robot ever was, contacts and
    the motions that led nowhere are set aside, since they may be the reason. told: the shield on the
    policy's map; shield: on the session's own.
    """
    if judged.some or not recovers(shield.config):
        return judged
    tried = judged.tried
    way, lost, said, (nearer, better) = most_kept(shield, judged.part, tried.motions)
    parts, able = lost, [each for each in shield.proposers if hasattr(each, "giving_up")]
    for alone in (True, False) if able and len(parts) > 1 else ():  # keep one part alone, then all but one
        few = [tuple(each for each in parts if (each == one) != alone) for one in parts[:MOST_PARTS]]
        asked = [adapted(each, "giving_up", some) for some in few for each in able]
        tried = together(tried, futures(now.prefix, shield.body, asked, None, (0.0,)))
        way, lost, said, (nearer, better) = most_kept(shield, judged.part, tried.motions)
        if len(parts) == 2 or lost == parts:  # if no part can be kept alone, no two can
            break
    awaited = _awaited(told, shield, taught, now)
    if awaited is not None and _loses(shield, judged.part, tried, awaited) == lost:
        way, said = np.array([awaited]), ("something is in every way that is left: it is waited for",)
    elif not nearer:
        known, marked, ways = taught.map, taught.map.occupied & (taught.map.by != SENT), judged.tried
        if marked.any() or len(taught.barred):  # contacts may be the reason
            free = on_map(told, revised(known, forget(known, marked)))
            asked = [adapted(each, "briefly") for each in free.proposers]
            ways = futures(now.prefix, free.body, asked, None, (0.0,))
            way, _, said, (_, better) = most_kept(free, judged.part, ways.motions)
            said = ("what contacts taught leaves no way, so it is ignored for this action", *said)
        way = way if better else np.array([ways.preferred])
    tried = judged.tried._replace(warnings=(*tried.warnings, *said))  # only the futures that were judged
    completion = int(shield.task.robot.representative[way[0]])
    return judged._replace(tried=tried, completion=completion, begun=way.astype(np.uint8).tobytes())


def _loses(shield: Shield, prefix: Prefix, tried: Futures, first: int) -> tuple[Formula, ...]:
    """What the motion `first` gives up at the least: if the robot then waits to the horizon, if it goes on as
    one of the futures that were tried, or if it goes back and begins one of them AROUND steps later.
    """
    pose, wait = prefix.poses[-1], shield.task.robot.wait_motion
    ends = spread(shield.body, np.array([step(shield.body, pose[0], pose[1], pose[2], first)]))
    back = np.argmin(np.hypot(*(ends - pose)[:, :2].T) - np.cos(ends[:, 2] - pose[2]))
    later = np.hstack([np.tile([first, back, *[wait] * AROUND], (len(tried.motions), 1)), tried.motions])
    still = np.array([[first, *[wait] * (prefix.steps - 1)]])
    motions = np.concatenate([tried.motions[tried.motions[:, 0] == first], still, later[:, : prefix.steps]])
    return most_kept(shield, prefix, motions)[1]


def _awaited(told: Shield, shield: Shield, taught: Taught, now: Situation) -> int | None:
    """The first motion of the way that there would be if every learned obstacle were gone, or the waiting
    motion if one of them hinders that motion. None if there is no such way, or the robot cannot wait.
    """
    known, wait = taught.map, told.task.robot.wait_motion
    if not known.occupied.any() or wait < 0:
        return None
    gone = on_map(told, revised(known, forget(known, known.occupied)), True, taught.barred)
    gone, _, judged, _ = judged_by_signals(gone, now)
    if not judged.some or judged.vain:
        return None
    motion, (x, y, theta) = int(told.task.robot.motion_of[judged.completion]), now.prefix.poses[-1]
    ends = [step(body, x, y, theta, motion) for body in (gone.body, shield.body)]
    return motion if ends[0] == ends[1] else wait
