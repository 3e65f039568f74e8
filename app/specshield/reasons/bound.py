"""Whether it can be shown that no future satisfies the formula, whatever the robot does.

The first steps are followed exactly: every pose that some list of motions leads to. From there on the robot
is given more freedom than it has: it turns at no cost, its way is as short as the floor allows (ground.py),
and it only has to visit the places that the formula needs (needs.py), in any order. If not even that can be
in time, there is no future; else nothing is known.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from specshield.arrays import Floats, Ints
from specshield.caution.escape import spread
from specshield.reasons.course import Goal, course, possible
from specshield.reasons.ground import Ground, make_ground
from specshield.reasons.known import Known
from specshield.reasons.needs import Need, Reader, positive
from specshield.robot.dynamics import Body, in_collision, motion_count
from specshield.stl import Always, Atom, Comparison, Not
from specshield.stl.formula import Node
from specshield.task import Task

# Chosen by hand: what is looked at stays within a second.
MOST_POSES = 10_000  # at one of the first steps
MOST_STEPS = 12  # that are followed exactly
MOST_GOALS = 6  # whose order is looked at
EDGE = 1e-6  # [m] a point this near to an edge counts as on both sides of it
SAME = 1e7  # poses that are equal after multiplying by this and rounding are one


def proof(task: Task, body: Body, history: Floats, signals: Mapping[str, Floats]) -> str | None:
    """Why no future of x_0..x_t, history [t + 1, 3], satisfies the task's formula; None where that is open.

    signals {name: [t + 1]}. They are taken to hold their last values.
    """
    if in_collision(body, *history[-1]):  # f leads out of obstacles by ways that no free floor shows
        return None
    known = Known(task, history, signals)
    ways = Reader(known.now, known.constant).alternatives(task.formula)
    if not ways:
        return "the values that the signals hold rule it out"
    ground, said = make_ground(task, body, known.held), ""
    for needs in ways:
        refuted = _refuted(needs, known, ground, body)
        if refuted is None:
            return None
        said = said or refuted
    return said if len(ways) == 1 else f"{said}; and its {len(ways) - 1} other ways are ruled out likewise"


def contradiction(task: Task, body: Body) -> str | None:
    """Why no start satisfies the formula while the signals have their initial values; None if that is not
    shown. Only needs that hold nowhere are looked for, not places that are too far away.
    """
    known = Known(task, np.empty((0, 3)), {})
    ground, said = make_ground(task, body, known.held), list[str]()
    for needs in Reader(known.now, known.constant).alternatives(task.formula):
        asked = course(needs, known, ground)
        if not isinstance(asked, str):
            return None
        said.append(asked)
    return said[0] if said else "the values that the signals hold rule it out"


def idle(task: Task, body: Body) -> Iterator[str]:
    """A warning about each part of the formula that holds wherever the robot fits, and so asks for nothing.
    It may be about a forbidden place that is off the map, or have an angle in degrees.
    """
    ground, nodes = make_ground(task, body, {}), list[Node]([positive(task.formula)])
    for node in nodes:
        if not isinstance(node, Not | Atom | Comparison):
            nodes.extend(node.parts)
        elif task.signals.keys().isdisjoint(node.names) and not possible(positive(node, True), ground).any():
            right = "are its place and its units right (metres, radians, the map's frame)?"
            yield f"'{node}' holds wherever the robot fits, so it asks for nothing; {right}"


def _refuted(needs: Sequence[Need], known: Known, ground: Ground, body: Body) -> str | None:
    """Why these needs cannot all be met; None if that is not shown. If one of them cannot be met even by
    itself, only that one is named.
    """
    asked = course(needs, known, ground)
    if isinstance(asked, str):
        return asked
    why, suspects = _Ahead(known, ground, body, asked.guards, asked.goals[:MOST_GOALS]).refuted()
    alone = (_refuted([need], known, ground, body) for need in suspects if len(needs) > 1)
    return next((said for said in alone if said is not None), why)


class _Ahead(NamedTuple):
    known: Known
    ground: Ground
    body: Body
    guards: Sequence[Need]
    goals: Sequence[Goal]

    def refuted(self) -> tuple[str | None, list[Need]]:
        """Why the needs cannot all be met, and the needs that may be the cause."""
        now, poses, met = self.known.now, self.known.history[-1:], np.zeros(1, np.int64)
        step, limiting, soonest = now, list[Need](), [math.inf] * len(self.goals)
        while step < now + MOST_STEPS and len(poses) * motion_count(self.body) <= MOST_POSES:
            further, also = self._onward(poses, met, step + 1, limiting, soonest)
            if not len(further):
                asked = " or ".join(str(guard.formula) for guard in limiting)
                return f"whatever the robot does, it breaks {asked} by step {step + 1}", limiting
            poses, met, step = further, also, step + 1
        if step == now:
            return None, []
        return self._too_late(poses, met, step, soonest)

    def _onward(
        self, poses: Floats, met: Ints, step: int, limiting: list[Need], soonest: list[float]
    ) -> tuple[Floats, Ints]:
        """The poses that one more motion leads to and that keep the guards at that step, each with the goals
        that were met on the way, one bit a goal. Adds the guards that some pose breaks to `limiting`, and to
        `soonest` [goals] the first step at which each goal's place is reached, in its window or not.
        """
        further, also = spread(self.body, poses), np.repeat(met, motion_count(self.body))
        alike = np.column_stack([further[:, :2], np.cos(further[:, 2]), np.sin(further[:, 2])])
        keys = np.column_stack([np.round(SAME * alike), also])
        _, first = np.unique(keys, axis=0, return_index=True)
        further, also = further[np.sort(first)], also[np.sort(first)]
        keeps = np.ones(len(further), np.bool_)
        for guard in self.guards:
            if guard.first <= step <= guard.end:
                kept = self.known.at(guard.predicate, further)
                keeps &= kept
                if not kept.all() and guard not in limiting:
                    limiting.append(guard)
        further, also = further[keeps], also[keeps].copy()
        for bit, goal in enumerate(self.goals if len(further) else ()):
            there = self.known.at(goal.need.predicate, further)
            if there.any():
                soonest[bit] = min(soonest[bit], step)
            if goal.need.first <= step <= goal.need.last:
                also[there] |= 1 << bit
        return further, also

    def _too_late(
        self, poses: Floats, met: Ints, step: int, soonest: Sequence[float]
    ) -> tuple[str | None, list[Need]]:
        """The result of `refuted`: why from none of these poses all goals can be met in time."""
        # apart: the fewest steps from a place where one goal is met to one where the other is
        far = np.array([[b.far[a.where].min() for b in self.goals] for a in self.goals])
        apart = self.ground.steps(far).tolist()
        steps = np.column_stack(
            [np.empty((len(poses), 0)), *(self._nearest(goal, poses) for goal in self.goals)]
        )
        if any(
            self._in_some_order(int(bits), row, apart, step) for bits, row in zip(met, steps, strict=True)
        ):
            return None, []
        for bit, goal in enumerate(self.goals):
            if (met >> bit & 1).any():
                continue
            need, soon = goal.need, min(soonest[bit], step + float(steps[:, bit].min()))
            beside = [g.formula for g in self.guards if g.formula is not need.formula and g.first <= step]
            others = [*beside, *([] if need.before is None else [need.before])]
            kept = " and ".join(f"'{each}'" for each in others)
            also = f" while {kept} is kept" if kept else ""
            if soon == math.inf:
                return f"no way leads to where {need.formula} can be met{also}", [need]
            if soon > need.last:
                by = "the rule" if need.before is not None else f"'{need.formula}'"
                away = f"'{need.predicate}' cannot be met from here before step {int(soon)}{also}"
                due = "from" if isinstance(need.formula, Always) else "by"
                return f"{away}, and {by} needs it {due} step {need.last}", [need]
        asked = ", ".join(str(goal.need.formula) for goal in self.goals)
        return f"not all of these can be reached in time, in whatever order: {asked}", []

    def _nearest(self, goal: Goal, poses: Floats) -> Floats:
        """The fewest steps to a goal from each pose, inf where no way leads there. A centre on an edge is in
        the squares on both sides.
        """
        moved = [poses + np.array([dx, dy, 0.0]) for dx in (-EDGE, EDGE) for dy in (-EDGE, EDGE)]
        return self.ground.steps(np.min([goal.far[self.ground.squares(each)] for each in moved], axis=0))

    def _in_some_order(self, met: int, first: Floats, apart: Sequence[Sequence[float]], step: int) -> bool:
        """Whether the goals that are not met yet can be, one after the other (Held and Karp, 1962)."""
        every = (1 << len(self.goals)) - 1
        soonest: dict[tuple[int, int], float] = {(met, -1): float(step)}
        for done in range(met, every + 1):
            for last in [-1, *range(len(self.goals))]:
                begun = soonest.get((done, last))
                if begun is None:
                    continue
                if done == every:
                    return True
                for bit, goal in enumerate(self.goals):
                    if done >> bit & 1:
                        continue
                    way = float(first[bit]) if last < 0 else apart[last][bit]
                    stay = self.goals[last].need.stay if last >= 0 and way > 0.0 else 0
                    at = max(begun + stay + way, float(goal.need.first))
                    key = (done | 1 << bit, bit)
                    if at <= goal.need.last and at < soonest.get(key, math.inf):
                        soonest[key] = at
        return False
