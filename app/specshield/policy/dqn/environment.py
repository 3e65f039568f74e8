"""Many robots at once that practise one formula: the training environment, compiled.

Half of the episodes begin in their middle, with consistent progress: a policy has to take over at any time.
Time is part of the observation, so an episode's end at the horizon is a termination, not a truncation.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from specshield.compiled import kernel
from specshield.errors import MapError
from specshield.policy.dqn.funnel import Funnels, make_funnels, reward
from specshield.policy.dqn.observation import Sight, make_sight, observation_size, observe, outcome
from specshield.robot.dynamics import Body, in_collision, make_body, motion_count, successors
from specshield.rule.progress import (
    ALWAYS,
    BROKEN,
    PENDING,
    SETTLED,
    STACK,
    Rules,
    advance,
    make_rules,
    read_predicates,
    value_count,
)
from specshield.task import Task


class Environment:
    """`robots` robots; `observations` (N, F) float32 are what each sees now. One seed decides everything."""

    def __init__(self, task: Task, robots: int, seed: int, literal: bool = False) -> None:
        self.task = task
        self.body, self.rules = make_body(task.robot, task.grid), make_rules(task)
        self.sight = make_sight(task, self.rules, self.body)
        self.random = np.random.default_rng(seed)
        probe = free_poses(task, self.body, 4096, np.random.default_rng(0))
        values = _predicates_at(self.rules, probe)
        self.funnels = make_funnels(self.rules, self.sight, values.min(axis=0), values.max(axis=0), literal)
        k, m = len(self.rules.kind), motion_count(self.body)
        self.pose = np.zeros((robots, 3))
        self.t = np.full(robots, task.horizon, dtype=np.int64)  # past the end: the first step resets all
        self.status = np.zeros((robots, k), dtype=np.int8)
        self.run = np.zeros((robots, k), dtype=np.int64)
        self.nexts = np.zeros((robots, m, 3))
        self.observations = np.zeros((robots, observation_size(self.rules, self.body)), dtype=np.float32)
        self.step(np.zeros(robots, dtype=np.int64))

    def step(self, motions: NDArray[np.int64]) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Each robot takes a motion (N,). Rewards and which episodes ended, (N,); those begin anew."""
        n, k = self.status.shape
        fresh = free_poses(self.task, self.body, n, self.random)
        times = np.where(self.random.random(n) < 0.5, 0, self.random.integers(0, self.task.horizon, n))
        rewards, ended = np.zeros(n, np.float32), np.zeros(n, np.bool_)
        _step_all(
            self.body, self.rules, self.sight, self.funnels, self.pose, self.t, self.status, self.run,
            self.nexts, self.observations, motions, fresh, times, self.random.random((n, k)), rewards, ended,
        )  # fmt: skip
        return rewards, ended


def free_poses(task: Task, body: Body, n: int, random: np.random.Generator) -> NDArray[np.float64]:
    """Poses drawn uniformly over free space, none in collision. Shape (n, 3). The heading is uniform too."""
    xmin, ymin, xmax, ymax = task.grid.bounds
    kept = np.empty((0, 3))
    for _ in range(1000):
        draw = random.random((2 * n + 64, 3))
        poses = np.array([xmin, ymin, -math.pi]) + draw * np.array([xmax - xmin, ymax - ymin, 2 * math.pi])
        kept = np.concatenate([kept, poses[~_colliding(body, poses)]])
        if len(kept) >= n:
            return kept[:n]
    raise MapError(
        "the map has next to no free space for this robot", path="map",
        got=f"a radius of {task.robot.radius:g} m", expected="a larger map or a smaller footprint",
    )  # fmt: skip


@kernel
def _colliding(body: Body, poses: NDArray[np.float64]) -> NDArray[np.bool_]:
    out = np.empty(poses.shape[0], np.bool_)
    for i in range(poses.shape[0]):
        out[i] = in_collision(body, poses[i, 0], poses[i, 1], poses[i, 2])
    return out


@kernel
def _predicates_at(rules: Rules, poses: NDArray[np.float64]) -> NDArray[np.float64]:
    out = np.empty((poses.shape[0], rules.kind.shape[0]))
    values, stack = np.empty(value_count(rules)), np.empty(STACK)
    for i in range(poses.shape[0]):
        read_predicates(rules, poses[i, 0], poses[i, 1], poses[i, 2], values, stack, out[i])
    return out


@kernel
def _begin(
    rules: Rules,
    t: int,
    predicates: NDArray[np.float64],
    chance: NDArray[np.float64],
    status: NDArray[np.int8],
    run: NDArray[np.int64],
) -> None:
    """Progress that a robot at step t could have: windows gone by are settled, open ones by chance."""
    run[:] = 0
    for k in range(rules.kind.shape[0]):
        status[k] = PENDING
        if rules.last[k] < t:
            status[k] = SETTLED
        elif rules.kind[k] != ALWAYS and rules.a[k] < t:
            open_for = (t - rules.a[k]) / (rules.last[k] - rules.a[k] + 1.0)
            if chance[k] < max(open_for, 0.5):
                status[k] = SETTLED
    advance(rules, t, predicates, status, run)


@kernel
def _step_all(
    body: Body,
    rules: Rules,
    sight: Sight,
    funnels: Funnels,
    pose: NDArray[np.float64],
    t: NDArray[np.int64],
    status: NDArray[np.int8],
    run: NDArray[np.int64],
    nexts: NDArray[np.float64],
    observations: NDArray[np.float32],
    motions: NDArray[np.int64],
    fresh: NDArray[np.float64],
    times: NDArray[np.int64],
    chance: NDArray[np.float64],
    rewards: NDArray[np.float32],
    ended: NDArray[np.bool_],
) -> None:
    values, stack = np.empty(value_count(rules)), np.empty(STACK)
    predicates, after = np.empty(rules.kind.shape[0]), np.empty(rules.kind.shape[0])
    for i in range(pose.shape[0]):
        over = t[i] >= sight.horizon
        if not over:
            pose[i] = nexts[i, motions[i]]
            t[i] += 1
            read_predicates(rules, pose[i, 0], pose[i, 1], pose[i, 2], values, stack, predicates)
            advance(rules, t[i], predicates, status[i], run[i])
            rewards[i] = reward(body, rules, sight, funnels, t[i], pose[i], status[i], predicates)
            over = t[i] >= sight.horizon
            if outcome(status[i]) == BROKEN:
                over = True
                if not funnels.literal:
                    rewards[i] = min(rewards[i], np.float32(0.0))
        if over:
            ended[i] = True
            pose[i] = fresh[i]
            t[i] = times[i]
            read_predicates(rules, pose[i, 0], pose[i, 1], pose[i, 2], values, stack, predicates)
            _begin(rules, t[i], predicates, chance[i], status[i], run[i])
            if outcome(status[i]) == BROKEN:  # begun inside a forbidden region: over at the next step
                t[i] = sight.horizon
        successors(body, pose[i], nexts[i])
        observe(
            body, rules, sight, t[i], pose[i], status[i], run[i], predicates, nexts[i], values, stack, after,
            observations[i],
        )  # fmt: skip
