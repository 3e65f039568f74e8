"""Measures how often a model without a shield finds its target: figures for the learned model's card."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.stats import beta

from evaluation.model.floor_plans import House
from specshield.policy.dqn.environment import free_poses
from specshield.robot import STRETCH
from specshield.sim.cases import Case
from specshield.sim.learned.model import LearnedModel
from specshield.sim.model import FoundationModel, softmax
from specshield.sim.robot import SimulatedRobot
from specshield.task import make_task

MAX_STEPS = 600


def alone(case: Case, model: FoundationModel, seed: int, i: int) -> tuple[bool, int]:
    """Run i of an unshielded campaign with `seed`: whether the model found its target, and its steps."""
    own = int(np.random.SeedSequence([seed, i]).generate_state(1)[0])
    x, y, theta = free_poses(case.task, case.body, 1, np.random.default_rng([own, 2]))[0].tolist()
    robot, random = SimulatedRobot(case, (x, y, theta)), np.random.default_rng([own, 1])
    model.reset(np.random.default_rng([own, 0]))
    for t in range(MAX_STEPS):
        action = int(random.choice(len(STRETCH.actions), p=softmax(model.logits(robot))))
        if STRETCH.terminal[action]:
            return robot.at_target, t
        robot.execute(action)
    return False, MAX_STEPS


def success(runs: Sequence[tuple[Case, LearnedModel]], seed: int) -> dict[str, Any]:
    """Over one run of each: the share that found their target, its 95 % Clopper-Pearson interval, steps."""
    results = [alone(case, model, seed, i) for i, (case, model) in enumerate(runs)]
    n, found = len(results), sum(ok for ok, _ in results)
    low = float(beta.ppf(0.025, found, n - found + 1)) if found else 0.0
    high = float(beta.ppf(0.975, found + 1, n - found)) if found < n else 1.0
    steps = [t for ok, t in results if ok]
    return {
        "runs": n, "seed": seed, "found": found, "share": found / n,
        "interval": [round(low, 4), round(high, 4)],
        "ended_elsewhere": sum(not ok and t < MAX_STEPS for ok, t in results),
        "median_steps": float(np.median(steps)) if steps else None,
    }  # fmt: skip


def house_case(house: House, kind: str) -> Case:
    """A house as a case whose rule is always kept."""
    task = make_task(house.grid, STRETCH, "G[0,1] x > -1000")
    return Case(
        "house",
        task,
        {},
        {"formula": str(task.formula), "regions": {}},
        f"find a {kind}",
        house.targets[kind],
    )
