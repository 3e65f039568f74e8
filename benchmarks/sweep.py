"""How a decision grows with the horizon and with the number of distinct actions, on made tasks."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.decisions import ask, warm
from benchmarks.states import State, shipped_dqn
from benchmarks.timing import summary
from specshield.episode import decide, make_shield
from specshield.policy.card import make_card
from specshield.policy.dqn.environment import free_poses
from specshield.policy.dqn.network import NAMES, make_network
from specshield.policy.dqn.observation import PER_MOTION, observation_size
from specshield.policy.dqn.policy import Policy
from specshield.policy.progress import make_rules
from specshield.policy.reachability import policy as reachability
from specshield.robot import STRETCH, Robot
from specshield.robot.actions import Action
from specshield.robot.dynamics import make_body, motion_count
from specshield.sim.cases import load_case
from specshield.stl import SATISFIED_ABOVE, robustness_bounds
from specshield.task import Task, make_task

HORIZONS = (20, 50, 100, 200, 500, 1000)
ACTIONS = (7, 16, 32, 64)
UNITS = 64


def by_horizon(horizons: tuple[int, ...], n: int, repeats: int, seed: int) -> list[dict[str, Any]]:
    """Case 2 with its windows stretched to each horizon; the shipped DQN's weights see them as their own."""
    case, rows = load_case("case2"), []
    network = shipped_dqn(case).network
    for horizon in horizons:
        a, b = horizon // 3, 2 * horizon // 3
        formula = (
            f"F[0,{a}] Region1 and F[{a},{b}] Region2 and F[{b},{horizon}] Region3 "
            f"and G[0,{horizon}] not Forbidden"
        )
        task = make_task(case.task.grid, STRETCH, formula, case.spec["regions"])
        dqn = Policy(task, make_card(task, "dqn", {}, 0, {}), network)
        rows.append({"horizon": horizon, **_row(task, dqn, n, repeats, seed)})
    return rows


def by_actions(counts: tuple[int, ...], n: int, repeats: int, seed: int) -> list[dict[str, Any]]:
    """Case 2 for robots with so many distinct motions: the shipped DQN, which uses its own seven; and `lost`,
    one of random weights, which satisfies nothing: each motion is then followed by a rollout of its own, and
    each step of it looks at each motion.
    """
    case, rows = load_case("case2"), []
    for count in counts:
        task = make_task(case.task.grid, made_robot(count), case.spec["formula"], case.spec["regions"])
        row = {"actions": count, **_row(task, widened(shipped_dqn(case), task), n, repeats, seed)}
        lost = random_dqn(task, seed)
        row["lost"] = summary([ask(make_shield([lost]), state, repeats) for state in _states(task, n, seed)])
        rows.append(row)
    return rows


def made_robot(count: int) -> Robot:
    """`count` motions: the Stretch's seven, then turns and arcs to either side by 6 degrees more each."""
    moves = list(STRETCH.motions)
    for ahead in (0.0, 0.1, 0.2):
        for angle in (math.radians(6.0 * k) for k in range(2, 16) if k != 5):
            moves += [(ahead, angle), (ahead, -angle)]
    actions = tuple(Action(f"a{i}", *move) for i, move in enumerate(moves[:count]))
    return Robot(f"made{count}", STRETCH.radius, STRETCH.offset, STRETCH.on_contact, actions)


def widened(dqn: Policy, task: Task) -> Policy:
    """A DQN for a robot that has more motions after the ones it was trained with: it never prefers those."""
    arrays = dqn.network._asdict()
    more = len(task.robot.motions) - len(dqn.task.robot.motions)
    arrays["w1"] = np.pad(arrays["w1"], ((0, PER_MOTION * more), (0, 0)))
    arrays["w3"] = np.pad(arrays["w3"], ((0, 0), (0, more)))
    arrays["b3"] = np.pad(arrays["b3"], (0, more), constant_values=np.float32(-1e6))
    network = make_network(arrays, len(arrays["w1"]), len(arrays["b3"]))
    return Policy(task, make_card(task, "dqn", {}, 0, {}), network)


def random_dqn(task: Task, seed: int) -> Policy:
    body = make_body(task.robot, task.grid)
    random = np.random.default_rng(seed)
    widths = [observation_size(make_rules(task), body), UNITS, UNITS, motion_count(body)]
    arrays = {}
    for i, (fan_in, fan_out) in enumerate(pairwise(widths)):
        scale = 1.0 / math.sqrt(fan_in)
        arrays[NAMES[2 * i]] = random.normal(0.0, scale, (fan_in, fan_out)).astype(np.float32)
        arrays[NAMES[2 * i + 1]] = np.zeros(fan_out, np.float32)
    network = make_network(arrays, widths[0], widths[-1])
    return Policy(task, make_card(task, "dqn", {}, seed, {}), network)


def _row(task: Task, dqn: Policy, n: int, repeats: int, seed: int) -> dict[str, Any]:
    """Quantiles of (c) and (d) from the same starts, feasible or not, and the seconds synthesis took."""
    reach = reachability.synthesise(task)
    states = _states(task, n, seed)
    row: dict[str, Any] = {"synthesis_s": reach.card["metrics"]["wall_time_s"]}
    for key, policy in (("c", dqn), ("d", reach)):
        shield = make_shield([policy])
        warm(shield, states[0])
        row[key] = summary([ask(shield, state, repeats) for state in states])
        answers = [decide(shield, state.history, state.logits) for state in states]
        row[key]["feasible"] = float(np.mean([answer.feasible_mass > 0.0 for answer in answers]))
    return row


def _states(task: Task, n: int, seed: int) -> list[State]:
    """Starts, feasible or not, that do not break the rule already."""
    poses = free_poses(task, make_body(task.robot, task.grid), 2 * n, np.random.default_rng([seed, 20]))
    whole = [pose for pose in poses if _bounds(task, pose)[1] > SATISFIED_ABOVE][:n]
    return [State(pose[None], np.zeros(len(task.robot.actions)), None) for pose in whole]


def _bounds(task: Task, pose: NDArray[np.float64]) -> tuple[float, float]:
    low, high = robustness_bounds(task.formula, task.samples(pose[None], {}))
    return float(low), float(high)
