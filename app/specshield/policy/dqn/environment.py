"""Many robots at once that practise one formula: the training environment, compiled.

Half of the episodes begin in their middle, with progress that a robot could have made by then, since a policy
has to take over at any time. Time is part of the observation, so an episode's end at the horizon is a
termination, not a truncation.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from specshield.arrays import Bools, Floats, Int8s, Ints, Singles
from specshield.compiled import kernel
from specshield.errors import MapError
from specshield.policy.dqn.funnel import Funnels, make_funnels, reward
from specshield.policy.dqn.observation import State, make_state, observation_size, observe, outcome, place
from specshield.policy.dqn.scene import Scene, make_scene, predicates_at
from specshield.policy.progress import ALWAYS, BROKEN, PENDING, SETTLED, Rules, advance
from specshield.robot.dynamics import Body, in_collision, motion_count, successors
from specshield.task import Task

FROM_THE_START = 0.5  # share of the episodes that begin at t = 0; chosen by hand, nothing was measured
PROBES = 4096  # poses over which the least and greatest robustness of a predicate are taken


class Robots(NamedTuple):
    """Where N robots are in their episodes. The members are `State`'s, one row for each robot."""

    t: Ints  # [N]
    pose: Floats  # [N, 3]
    status: Int8s  # [N, K]
    run: Ints  # [N, K]
    nexts: Floats  # [N, M, 3]
    observation: Singles  # [N, F] what each one sees now


class Environment:
    """`count` robots. One seed decides everything. literal: the paper's reward (policy/dqn/funnel.py)."""

    def __init__(self, task: Task, count: int, seed: int, literal: bool = False) -> None:
        self.task, self.scene = task, make_scene(task)
        self.random = np.random.default_rng(seed)
        body, rules = self.scene.body, self.scene.rules
        probed = predicates_at(rules, free_poses(task, body, PROBES, np.random.default_rng(0)))
        self.funnels = make_funnels(self.scene, probed.min(axis=0), probed.max(axis=0), literal)
        k, m, inputs = len(rules.kind), motion_count(body), observation_size(rules, body)
        self.robots = Robots(
            t=np.full(count, task.horizon, dtype=np.int64),  # so that the first step begins all episodes
            pose=np.zeros((count, 3)),
            status=np.zeros((count, k), dtype=np.int8),
            run=np.zeros((count, k), dtype=np.int64),
            nexts=np.zeros((count, m, 3)),
            observation=np.zeros((count, inputs), dtype=np.float32),
        )
        self.step(np.zeros(count, dtype=np.int64))

    def step(self, motions: Ints) -> tuple[Singles, Bools]:
        """Each robot takes its motion, (N,). Returns the rewards (N,) and which episodes ended (N,).

        The robots whose episodes ended are at the beginning of their next.
        """
        n, k = self.robots.status.shape
        fresh = free_poses(self.task, self.scene.body, n, self.random)
        midway = self.random.random(n) >= FROM_THE_START
        times = np.where(midway, self.random.integers(0, self.task.horizon, n), 0)
        chance = self.random.random((n, k))
        return _step_all(self.scene, self.funnels, self.robots, motions, fresh, times, chance)


def free_poses(task: Task, body: Body, n: int, random: np.random.Generator) -> Floats:
    """Poses (n, 3) drawn uniformly over free space, none in collision; the heading is uniform too.

    Raises MapError for a map with next to no free space.
    """
    xmin, ymin, xmax, ymax = task.grid.bounds
    kept = np.empty((0, 3))
    # No point of a cell is farther from an obstacle than the clearance of its centre plus a cell, so a robot
    # with a larger radius fits nowhere. To find that by drawing takes 20 s for a radius of 5 m.
    fits = body.clearance.max() + body.resolution > body.radius
    for _ in range(1000 if fits else 0):
        draw = random.random((2 * n + 64, 3))
        poses = np.array([xmin, ymin, -math.pi]) + draw * np.array([xmax - xmin, ymax - ymin, 2 * math.pi])
        kept = np.concatenate([kept, poses[_are_free(body, poses) & task.grid.holds(poses[:, :2])]])
        if len(kept) >= n:
            return kept[:n]
    got, expected = f"a radius of {task.robot.radius:g} m", "a larger map or a smaller footprint"
    raise MapError("the map has next to no free space for this robot", path="map", got=got, expected=expected)


@kernel
def _are_free(body: Body, poses: Floats) -> Bools:
    out = np.empty(poses.shape[0], np.bool_)
    for i in range(poses.shape[0]):
        out[i] = not in_collision(body, poses[i, 0], poses[i, 1], poses[i, 2])
    return out


@kernel
def begin_episode(rules: Rules, t: int, chance: Floats, state: State) -> None:
    """Gives the robot at x_t progress that it could have: obligations that are due before t are settled,
    those whose window is open are settled by chance, and x_t itself counts.

    chance (K,): uniform in [0, 1). The more of a window is over, the likelier it is settled; the probability
    is at least 0.5.
    """
    status = state.status
    for k in range(rules.kind.shape[0]):
        status[k], state.run[k] = PENDING, 0
        if rules.last[k] < t:
            status[k] = SETTLED
        elif rules.kind[k] != ALWAYS and rules.a[k] < t:
            over = (t - rules.a[k]) / (rules.last[k] - rules.a[k] + 1.0)
            if chance[k] < max(over, 0.5):
                status[k] = SETTLED
    advance(rules, t, state.predicates, status, state.run)


@kernel
def _step_all(
    scene: Scene, funnels: Funnels, robots: Robots, motions: Ints, fresh: Floats, times: Ints, chance: Floats
) -> tuple[Singles, Bools]:
    """`Environment.step`. fresh (N, 3), times (N,), chance (N, K): where a new episode would begin."""
    rules, t = scene.rules, robots.t
    rewards, ended = np.zeros(t.shape[0], np.float32), np.zeros(t.shape[0], np.bool_)
    scratch = make_state(scene, robots.observation.shape[1])
    for i in range(t.shape[0]):
        state = State(
            robots.pose[i],
            robots.status[i],
            robots.run[i],
            scratch.predicates,
            robots.nexts[i],
            robots.observation[i],
            scratch.values,
            scratch.stack,
            scratch.after,
            scratch.far,
            scratch.seen,
        )
        scratch.seen[:] = np.nan
        over = t[i] >= scene.horizon
        if not over:
            t[i] += 1
            m = motions[i]
            place(rules, state.nexts[m, 0], state.nexts[m, 1], state.nexts[m, 2], state)
            advance(rules, t[i], state.predicates, state.status, state.run)
            rewards[i] = reward(scene, funnels, t[i], state)
            over = t[i] >= scene.horizon
            if outcome(state.status) == BROKEN:
                over = True
                if not funnels.literal:
                    rewards[i] = min(rewards[i], np.float32(0.0))
        if over:
            ended[i] = True
            t[i] = times[i]
            place(rules, fresh[i, 0], fresh[i, 1], fresh[i, 2], state)
            begin_episode(rules, t[i], chance[i], state)
            if outcome(state.status) == BROKEN:  # it began inside a forbidden region: over at the next step
                t[i] = scene.horizon
        successors(scene.body, state.pose, state.nexts)
        observe(scene, t[i], state)
    return rewards, ended
