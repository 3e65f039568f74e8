"""Look-ahead shaping: inside S_t, weigh what the model wants by what it will cost the model later.

Projection lets the model put a visit off until it is forced, step after step. A surrogate of the model,
fitted to the logits of the session, says what the rule will still cost from each next pose: D
(desirability.py). Weighing by exp(-D) spreads the cost over the path as the closest path distribution would.
Only the preference inside S_t changes: safety rests on S_t alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from specshield.compiled import kernel
from specshield.errors import Unsupported
from specshield.policy.lattice import pose_of
from specshield.policy.progress import SETTLED, Rules, make_rules, replay, signal_rows
from specshield.policy.reachability import ReachabilityPolicy, synthesise
from specshield.robot.unicycle import Body, make_body, successors
from specshield.shield import belief as beliefs
from specshield.shield.belief import Belief, Plan
from specshield.shield.desirability import NEVER, solve
from specshield.shield.expansion import expand_all
from specshield.shield.planes import Planes, make_planes
from specshield.shield.surrogate import FEATURES, Course, Goals, chart, follow, is_blocked, make_goals
from specshield.task import Task

Floats = NDArray[np.float64]
Codes = NDArray[np.uint16]

TABLES = 8  # solved, kept by a process: 20 MB each on the cases
NEGLIGIBLE = 0.01  # a weight not worth the work
WORST = 10.0  # [nats] more than the worst action that has a D, for those that have none


@dataclass(frozen=True, eq=False)
class LookAhead:
    """A task as the look-ahead sees it, prepared once."""

    task: Task
    body: Body
    rules: Rules
    goals: Goals
    planes: Planes

    def begin(self) -> Belief:
        return beliefs.begin(len(self.goals.distance), len(self.task.robot.motions))

    def step(
        self, belief: Belief, history: Floats, signals: Mapping[str, Floats], log_prior: Floats
    ) -> tuple[Belief, Floats]:
        """What is believed after the model's log_prior [A] at x_t, and what to add to it inside S_t, [A].

        history [t + 1, 3] with t < T; signals {name: [t + 1]}. The addition is -weight * D of the next pose,
        at most 0; 0 for a terminal action and where nothing is known.
        """
        robot, pose = self.task.robot, history[-1]
        x, y, theta = (float(v) for v in pose)
        nexts = np.empty((len(robot.motions), 3))
        successors(self.body, pose, nexts)
        prior = np.exp(log_prior)
        going_on = prior[~robot.terminal]
        if going_on.sum() <= 0.0:  # the model ends for certain: it says nothing of where it would go
            return belief, np.zeros(len(prior))
        said = np.bincount(robot.motion_of[~robot.terminal], going_on, len(nexts)) / going_on.sum()
        blocked = np.array([is_blocked(self.body, m, x, y, theta, after) for m, after in enumerate(nexts)])
        end = float(prior[robot.terminal].sum())
        belief = beliefs.observe(belief, self.body, self.goals, len(history) - 1, pose, blocked, said, end)
        if belief.weight < NEGLIGIBLE:
            return belief, np.zeros(len(prior))
        costs = self._costs(belief, history, signals)
        return belief, np.where(robot.terminal, 0.0, -belief.weight * costs[robot.motion_of])

    def _costs(self, belief: Belief, history: Floats, signals: Mapping[str, Floats]) -> Floats:
        """D after each motion [M], above the least."""
        t = len(history) - 1
        rules = self.rules._replace(signals=self.rules.signals.copy())
        status, run = np.zeros(len(rules.kind), np.int8), np.zeros(len(rules.kind), np.int64)
        replay(rules, history, signal_rows(self.task, signals, t + 1), status, run)
        mask = sum(1 << g for g, k in enumerate(self.planes.goal) if status[k] == SETTLED)
        assert belief.plan is not None
        plan, costs = belief.plan, np.empty(len(self.task.robot.motions))
        course, table = _solved(self, plan)
        style = np.array(plan.style)
        x, y, theta = (float(v) for v in history[-1])
        expand_all(
            self.body, rules, course, self.planes, table, plan.since, style, t, mask, x, y, theta, costs
        )
        known = costs < NEVER
        if not known.any():
            return np.zeros(len(costs))
        costs[~known] = costs[known].max() + WORST
        costs -= costs.min()
        return costs


@lru_cache(maxsize=16)
def prepare(task: Task, policy: ReachabilityPolicy | None = None) -> LookAhead:
    """The look-ahead for a task; `policy`: one made for it, if there is any.

    Raises FragmentError outside the fragment, PolicyError or Unsupported for a task too large.
    """
    body, rules = make_body(task.robot, task.grid), make_rules(task)
    goals = make_goals(body, task.grid)
    if len(goals.distance) == 0:
        raise Unsupported(
            "the robot can turn freely nowhere on this map, so there is nowhere to think of it as going",
            path="shaping", got="lookahead", expected="'projection'",
        )  # fmt: skip
    planes = make_planes(body, rules, task.horizon, (policy or synthesise(task)).tables)
    return LookAhead(task, body, rules, goals, planes)


@lru_cache(maxsize=TABLES)
def _solved(ahead: LookAhead, plan: Plan) -> tuple[Course, Codes]:
    """The course of a plan, and D for a model on it."""
    chosen, weights = np.array([g for g, _ in plan.goals]), np.array([p for _, p in plan.goals])
    course = chart(ahead.goals, chosen, weights)
    shape = ahead.planes.valid.shape
    motions = np.zeros((len(ahead.task.robot.motions), *shape), np.float32)
    ends = np.zeros(shape, np.float32)
    _react_everywhere(ahead.body, course, ahead.planes, np.array(plan.style), motions, ends)
    return course, solve(ahead.body, ahead.planes, plan.since, motions, ends)


@kernel
def _react_everywhere(
    body: Body,
    course: Course,
    planes: Planes,
    style: Floats,
    motions: NDArray[np.float32],
    ends: NDArray[np.float32],
) -> None:
    """The surrogate at each pose of the lattice: motions [M, H, N], ends [H, N]."""
    headings, cells = planes.valid.shape
    features, log_r = np.empty((motions.shape[0], FEATURES)), np.empty(motions.shape[0])
    blocked = np.empty(motions.shape[0], np.bool_)
    for h in range(headings):
        for c in range(cells):
            if not planes.valid[h, c]:
                continue
            j, i = c // planes.width - planes.pad, c % planes.width - planes.pad
            x, y, theta = pose_of(body, planes.pitch, headings, j, i, h)
            for m in range(motions.shape[0]):
                blocked[m] = planes.free[m, h, c] == 0.0
            ends[h, c] = follow(body, course, style, x, y, theta, blocked, features, log_r)
            for m in range(motions.shape[0]):
                motions[m, h, c] = log_r[m]
