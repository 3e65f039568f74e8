"""A search for a future that meets given needs, without policies: step by step, in simulation.

It begins with every pose that one motion leads to, and goes on from those that leave the most steps to spare
on the way to the goals (ground.py). It goes on from a place once, when that is first reached, and again when
some window opens or closes. What it finds is simulated with f and can be judged like any other future. If it
finds nothing, that proves nothing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from specshield.arrays import Bools, Floats, Ints
from specshield.caution.escape import spread
from specshield.reasons.ground import Ground
from specshield.reasons.known import Known
from specshield.reasons.needs import Need
from specshield.robot.dynamics import Body, calmest_motion, motion_count
from specshield.stl import SATISFIED_ABOVE

# Chosen by hand: a search takes a second at most.
MOST_NODES = 60_000
WIDTH = 120  # poses that one step goes on from, for each set of goals that are met
MOST_MOTIONS = 1_500  # made from all of these poses
BEHIND = 8.0  # [steps] such a pose may have fewer to spare than the best one: what it takes to turn round
CELL, HEADINGS = 0.05, 120  # poses in one cell [m] and one of so many headings are one place


class Wanted(NamedTuple):
    """A need that a way has to meet. far [m]: from each of the ground's squares to where it may be met. due:
    the last step to begin it by, which is later than the need says if that may be late.
    """

    need: Need
    far: Floats
    due: int


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


def search(
    known: Known, ground: Ground, body: Body, guards: Sequence[Need], goals: Sequence[Wanted], until: int
) -> Ints | None:
    """Motions from x_t up to step `until` that meet the goals and keep the guards at every step of their
    windows; None where none were found.
    """
    wait, now, tree = calmest_motion(body), known.now, _Tree()
    waits = known.task.robot.wait_motion >= 0
    count, every = motion_count(body), (1 << len(goals)) - 1
    width = max(1, min(WIDTH, MOST_MOTIONS // count))
    stays = [k for k, goal in enumerate(goals) if goal.need.stay > 0]
    events = {goal.need.first for goal in goals} | {s for g in guards for s in (g.first, g.end + 1)}
    ids = tree.add(now, np.array([-1]), np.array([-1]))
    poses, met, run = known.history[-1:], np.zeros(1, np.int64), np.zeros((1, len(goals)), np.int64)
    pool: list[tuple[Ints, Floats, Ints]] = []
    seen = np.empty(0, np.int64)
    for step in range(now + 1, until + 1):
        if step in events and waits and pool:  # a robot that waited anywhere may go on from there
            ids, poses, met = (np.concatenate(each) for each in zip(*pool, strict=True))
            run, seen = np.zeros((len(ids), len(goals)), np.int64), np.empty(0, np.int64)
            chosen = _best(goals, ground, poses, met, run, step - 1, width)
            ids, poses, met, run = ids[chosen], poses[chosen], met[chosen], run[chosen]
        parent, motion = np.repeat(ids, count), np.tile(np.arange(count), len(ids))
        poses, met, run = spread(body, poses), np.repeat(met, count), np.repeat(run, count, axis=0)
        keep = _kept(known, guards, poses, step)
        poses, met, run, parent, motion = poses[keep], met[keep].copy(), run[keep], parent[keep], motion[keep]
        waiting = np.zeros(len(poses), np.bool_)
        for k, goal in enumerate(goals):
            holds = known.at(goal.need.predicate, poses, SATISFIED_ABOVE) & (met >> k & 1 == 0)
            run[:, k] = np.where(holds & (step >= goal.need.first), run[:, k] + 1, 0)
            met[(run[:, k] > goal.need.stay) & (step - goal.need.stay <= goal.due)] |= 1 << k
            waiting |= holds & (step < goal.need.first)
        keep = _so_far(known, goals, poses, met)
        if not keep.all():
            poses, met, run, parent, motion = poses[keep], met[keep], run[keep], parent[keep], motion[keep]
            waiting = waiting[keep]
        if (met == every).any():
            node = int(tree.add(step, parent, motion)[np.argmax(met == every)])
            return np.array(tree.way(node, wait) + [wait] * (until - step), np.int64)
        key = _key(poses, met, run[:, stays])
        _, first = np.unique(key, return_index=True)
        fresh = ~np.isin(key[first], seen) | waiting[first] if waits else np.ones(len(first), np.bool_)
        chosen = first[fresh]
        chosen = chosen[_best(goals, ground, poses[chosen], met[chosen], run[chosen], step, width)]
        if not len(chosen) and not any(event > step for event in events):
            return None
        poses, met, run = poses[chosen], met[chosen], run[chosen]
        ids = tree.add(step, parent[chosen], motion[chosen])
        pool.append((ids, poses, met))
        seen = np.concatenate([seen, key[chosen]])
        if tree.size > MOST_NODES:
            return None
    return None


def _kept(known: Known, guards: Sequence[Need], poses: Floats, step: int) -> Bools:
    keep = np.ones(len(poses), np.bool_)
    for guard in guards:
        if guard.first <= step <= guard.end:
            keep &= known.at(guard.predicate, poses, SATISFIED_ABOVE)
    return keep


def _so_far(known: Known, goals: Sequence[Wanted], poses: Floats, met: Ints) -> Bools:
    """Which poses keep what has to hold until a goal is met, unless it is."""
    keep = np.ones(len(poses), np.bool_)
    for k, goal in enumerate(goals):
        if goal.need.before is not None:
            keep &= (met >> k & 1 == 1) | known.at(goal.need.before, poses, SATISFIED_ABOVE)
    return keep


def _key(poses: Floats, met: Ints, run: Ints) -> Ints:
    """One number for each place, with what is met there."""
    cells = np.floor(poses[:, :2] / CELL).astype(np.int64) & 0xFFFF
    heading = np.round(poses[:, 2] * HEADINGS / (2.0 * math.pi)).astype(np.int64) % HEADINGS
    key = ((cells[:, 0] << 16 | cells[:, 1]) * HEADINGS + heading) << 8 | met
    for column in run.T:
        key = key * 1031 + column
    return key


def _best(
    goals: Sequence[Wanted], ground: Ground, poses: Floats, met: Ints, run: Ints, step: int, width: int
) -> Ints:
    """The poses to go on from: for each set of goals that are met, those with the most steps to spare."""
    at = ground.squares(poses)
    spare, hopeless = np.full(len(poses), np.inf), np.zeros(len(poses), np.bool_)
    for k, goal in enumerate(goals):
        ahead = ground.steps(goal.far[at])
        ahead = np.where(run[:, k] > 0, 1 - run[:, k], ahead)  # a goal that is being met was begun in time
        is_open = met >> k & 1 == 0
        hopeless |= is_open & (step + ahead > goal.due)
        spare = np.where(is_open, np.minimum(spare, goal.due - step - ahead), spare)
    order = np.argsort(-spare, kind="stable")
    order = order[~hopeless[order]]
    chosen = []
    for one in np.unique(met[order]):
        same = order[met[order] == one]
        chosen.append(same[spare[same] >= spare[same[0]] - BEHIND][:width])
    return np.concatenate(chosen) if chosen else np.empty(0, np.int64)
