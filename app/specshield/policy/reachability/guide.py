"""What climbs and beams share: how progress is kept, and when deadlines come earlier."""

from __future__ import annotations

import numpy as np

from specshield.arrays import Floats, Int8s, Ints, copy_row
from specshield.compiled import Boxed, inlined, kernel, leaf
from specshield.policy.lattice import Corners
from specshield.policy.progress import (
    ALWAYS,
    EVENTUALLY,
    EVENTUALLY_ALWAYS,
    PENDING,
    Past,
    Rules,
    advance,
    recall,
    value_count,
)
from specshield.policy.reachability.tables import Guide, Scratch, Tables, goals_settled, slack
from specshield.rule.values import REGIONS, fill_pose, fill_region
from specshield.stl.program import STACK_SIZE, VALUE, evaluate_packed

# [steps] The least slack, by the tables, with which a way to an earlier deadline is looked for. Of 8,200
# first motions with less slack 63 had a way, of 1,100 others 474 (docs/decisions.md).
HURRIED = -1.0


@kernel
def make_scratch(rules: Rules, motions: int) -> Scratch:
    k = rules.kind.shape[0]
    return Scratch(
        values=np.empty(value_count(rules)),
        stack=np.empty(STACK_SIZE),
        predicates=np.empty(k),
        scores=np.empty(motions),
        status=np.empty(k, np.int8),
        run=np.empty(k, np.int64),
        high_status=np.empty(k, np.int8),
        high_run=np.empty(k, np.int64),
        corners=Corners(np.empty(4, np.int64), np.empty(4)),
        ahead=Corners(np.empty(4, np.int64), np.empty(4)),
    )


@inlined
def copy_progress(status: Int8s, run: Ints, to_status: Int8s, to_run: Ints) -> None:
    for k in range(status.shape[0]):
        to_status[k], to_run[k] = status[k], run[k]


@inlined
def predicate_at(rules: Rules, k: int, x: float, y: float, theta: float, scratch: Scratch) -> float:
    """The robustness of one obligation's predicate at a pose: only the regions that it names are measured."""
    values = scratch.values
    fill_pose(x, y, theta, values)
    programs, first_signal = rules.programs, REGIONS + rules.regions.plain.shape[0]
    for i in range(programs.starts[k], programs.starts[k + 1]):
        if programs.ops[i] == VALUE:
            place = int(programs.args[i])
            if REGIONS <= place < first_signal:
                fill_region(rules.regions, place - REGIONS, values)
            elif place >= first_signal:
                values[place] = rules.signals[place - first_signal]
    return float(evaluate_packed(k, programs, values, scratch.stack))


@leaf
def due(rules: Rules, goal: int) -> int:
    """The last step by which a robot can come to where a goal's predicate holds."""
    if rules.kind[goal] == EVENTUALLY:
        return int(rules.b[goal])
    return int(rules.c1[goal] + rules.c2[goal])


@inlined
def update_progress(rules: Rules, t: int, x: float, y: float, theta: float, scratch: Scratch) -> None:
    """Takes x_t into the scratch's progress."""
    read_due(rules, t, x, y, theta, scratch)
    advance(rules, t, scratch.predicates, scratch.status, scratch.run)


@inlined
def read_due(rules: Rules, t: int, x: float, y: float, theta: float, scratch: Scratch) -> None:
    """Evaluates the predicates that `advance` needs at step t, or up to it for a robot that waits."""
    for k in range(rules.kind.shape[0]):
        if scratch.status[k] == PENDING and t >= rules.a[k] + rules.c2[k]:
            scratch.predicates[k] = predicate_at(rules, k, x, y, theta, scratch)


@inlined
def is_over(rules: Rules, tables: Tables, t: int, status: Int8s) -> bool:
    """Whether every goal is settled at step t and no `always` is still to begin."""
    return goals_settled(rules, status) and tables.phase[t] == len(tables.end) - 1


@inlined
def fill(n: int, wait: int, motions: Ints, poses: Floats) -> None:
    """Writes waits from motions[n], n >= 1, to the horizon, at the pose that motions[:n] led to."""
    for rest in range(n, motions.shape[0]):
        motions[rest] = wait
        copy_row(poses[n - 1], poses[rest])


def hurried(guide: Guide, margin: float, early: int, past: Past) -> tuple[Guide, bool]:
    """The guide for deadlines that come `early` steps earlier, and whether any does: those of each F that is
    open at step t and can still be met so early, and the begin of each G to come that does not hold at x_t.
    The window of an F keeps at least half its length. For a robot that cannot wait, no deadline comes
    earlier. margin [m]: by which x_0..x_t has settled what it has.
    """
    if guide.wait < 0:
        return guide, False
    a, b, c1 = guide.rules.a.copy(), guide.rules.b.copy(), guide.rules.c1.copy()
    rules = guide.rules._replace(a=a, b=b, c1=c1)
    now = Rules(*guide.rules[:-2], guide.rules.signals.copy(), margin)
    least, sooner = _hasten(now, early, past, a, b, c1)
    return guide._replace(rules=rules, tables=guide.tables._replace(early=least)), sooner


@kernel
def _hasten(rules: Rules, early: int, past: Past, a: Ints, b: Ints, c1: Ints) -> tuple[int, bool]:
    """Brings the ends b, c1 (K,) of open F and the begins a (K,) of G forward; the least change [steps], and
    whether there is any.
    """
    now, scratch = recall(rules, past), make_scratch(rules, 1)
    x, y, theta = now.pose
    least, met, moved = 0, False, False
    for k in range(rules.kind.shape[0]):
        kind, begin, end = rules.kind[k], rules.a[k], rules.b[k]
        if now.status[k] != PENDING:
            continue
        if kind == ALWAYS:
            sooner = max(begin - early, now.t + 1)
            if sooner >= begin or predicate_at(rules, k, x, y, theta, scratch) > rules.margin:
                continue
            end, a[k] = begin, sooner
        else:
            end = rules.c1[k] if kind == EVENTUALLY_ALWAYS else end
            sooner = end - min(early, (end - begin) // 2)
            if sooner + rules.c2[k] <= now.t:
                continue
            if kind == EVENTUALLY_ALWAYS:
                c1[k] = sooner
            else:
                b[k] = sooner
        least = min(least, end - sooner) if met else end - sooner
        met, moved = True, moved or sooner < end
    return least, moved


@kernel
def share_with_slack(boxed: Boxed[Guide], poses: Floats) -> float:
    """The share of the poses (N, 3) from which the tables leave time enough at the first step."""
    guide, found = boxed.value, 0
    scratch = make_scratch(guide.rules, 1)
    for n in range(poses.shape[0]):
        x, y, theta = poses[n, 0], poses[n, 1], poses[n, 2]
        scratch.status[:], scratch.run[:] = PENDING, 0
        update_progress(guide.rules, 0, x, y, theta, scratch)
        found += slack(guide, x, y, theta, 0, scratch) >= 0.0
    return float(found / poses.shape[0])
