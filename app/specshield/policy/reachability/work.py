"""What the tables' walks and beams share: what leads a robot, its scratch, and how progress is read."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from specshield.compiled import inlined, kernel
from specshield.policy.reachability.tables import Tables, goals_settled
from specshield.robot.dynamics import Body
from specshield.rule.progress import EVENTUALLY_ALWAYS, PENDING, STACK, Rules, advance, value_count
from specshield.rule.values import REGIONS, fill_pose, fill_region, region_count
from specshield.stl.program import VALUE, evaluate_packed


class Guide(NamedTuple):
    """What leads a robot: the world, the formula and its tables. wait: the motion that stands still."""

    body: Body
    rules: Rules
    tables: Tables
    wait: int


class Work(NamedTuple):
    """Scratch of a walk. status, run (K,): the progress at the newest pose; high_*: where the latest feasible
    time was highest."""

    values: NDArray[np.float64]
    stack: NDArray[np.float64]
    predicates: NDArray[np.float64]
    scores: NDArray[np.float64]
    status: NDArray[np.int8]
    run: NDArray[np.int64]
    high_status: NDArray[np.int8]
    high_run: NDArray[np.int64]


@kernel
def make_work(rules: Rules, motions: int) -> Work:
    k = rules.kind.shape[0]
    return Work(
        np.empty(value_count(rules)), np.empty(STACK), np.empty(k), np.empty(motions), np.empty(k, np.int8),
        np.empty(k, np.int64), np.empty(k, np.int8), np.empty(k, np.int64),
    )  # fmt: skip


@inlined
def predicate_at(rules: Rules, k: int, x: float, y: float, theta: float, work: Work) -> float:
    """The robustness of one obligation's predicate at a pose: only the regions that it names are measured."""
    values = work.values
    fill_pose(x, y, theta, values)
    programs, first_signal = rules.programs, REGIONS + region_count(rules.regions)
    for i in range(programs.starts[k], programs.starts[k + 1]):
        if programs.ops[i] == VALUE:
            place = int(programs.args[i])
            if REGIONS <= place < first_signal:
                fill_region(rules.regions, place - REGIONS, x, y, values)
            elif place >= first_signal:
                values[place] = rules.signals[place - first_signal]
    return float(evaluate_packed(k, programs, values, work.stack))


@inlined
def observe(rules: Rules, t: int, x: float, y: float, theta: float, work: Work) -> None:
    """Takes x_t into work's progress. Predicates that `advance` makes no use of are not read."""
    for k in range(rules.kind.shape[0]):
        opens = rules.a[k] + (rules.c2[k] if rules.kind[k] == EVENTUALLY_ALWAYS else 0)
        if work.status[k] == PENDING and t >= opens:
            work.predicates[k] = predicate_at(rules, k, x, y, theta, work)
    advance(rules, t, work.predicates, work.status, work.run)


@inlined
def look(rules: Rules, x: float, y: float, theta: float, work: Work) -> None:
    """Reads the predicates of everything that is pending, for a robot that will wait here."""
    for k in range(rules.kind.shape[0]):
        if work.status[k] == PENDING:
            work.predicates[k] = predicate_at(rules, k, x, y, theta, work)


@inlined
def is_over(rules: Rules, tables: Tables, t: int, status: NDArray[np.int8]) -> bool:
    """Whether every goal is settled at step t and no `always` is still to begin."""
    return goals_settled(rules, status) and tables.phase[t] == len(tables.end) - 1


@inlined
def fill(
    n: int,
    wait: int,
    x: float,
    y: float,
    theta: float,
    motions: NDArray[np.int64],
    poses: NDArray[np.float64],
) -> None:
    """Waits from n to the end."""
    for rest in range(n, motions.shape[0]):
        motions[rest] = wait
        poses[rest, 0], poses[rest, 1], poses[rest, 2] = x, y, theta
