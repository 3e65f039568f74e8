"""The formula's progress along a trajectory: which of its obligations are settled, and which are broken.

pi_phi sees time and pose, but phi depends on the history: a charger may have been visited already. The
progress is all of the history that still matters to a formula of the paper's fragment. A policy plans with
what the past has settled for a margin, and with what is left to do once an obligation is broken.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np

from specshield.arrays import Floats, Int8s, Ints, copy_row
from specshield.caution.residual import again, all_of, left_over
from specshield.compiled import inlined, kernel, leaf
from specshield.errors import FragmentError
from specshield.policy.progress.obligations import obligations
from specshield.rule.values import REGIONS, fill_pose, fill_region, places, regions_of
from specshield.stl import Formula
from specshield.stl.program import STACK_SIZE, Programs, compile_predicates, evaluate_packed
from specshield.task import Task
from specshield.world.regions import PackedRegions

EVENTUALLY, ALWAYS, EVENTUALLY_ALWAYS = 0, 1, 2
KINDS = {"eventually": EVENTUALLY, "always": ALWAYS, "eventually_always": EVENTUALLY_ALWAYS}
PENDING, SETTLED, BROKEN = 0, 1, 2
MAX_OBLIGATIONS = 8


class Rules(NamedTuple):
    """A formula's K obligations as flat arrays."""

    kind: Ints  # [K]
    a: Ints  # [K] windows in absolute steps, closed
    b: Ints
    c1: Ints
    c2: Ints
    last: Ints  # [K] the step by which the obligation is decided
    programs: Programs  # of the K predicates, over `values` (rule/values.py)
    regions: PackedRegions
    signals: Floats  # [S] the value each signal holds
    margin: float  # an obligation holds where its predicate's robustness is above this


class Past(NamedTuple):
    """The states x_0..x_t: poses (t + 1, 3), signals (t + 1, S), and the margin that they have to keep."""

    margin: float
    poses: Floats
    signals: Floats


class Present(NamedTuple):
    """Where a robot is: at x_t, pose (3,), with the progress status, run (K,) by then."""

    t: int
    pose: Floats
    status: Int8s
    run: Ints


def make_rules(task: Task) -> Rules:
    """Compiles the task's formula. Raises FragmentError outside the paper's fragment or MAX_OBLIGATIONS."""
    parts = obligations(task.formula)
    if len(parts) > MAX_OBLIGATIONS:
        expected = f"at most {MAX_OBLIGATIONS}; or the method 'planner', which takes any formula"
        raise FragmentError("the formula has too many parts", got=len(parts), expected=expected)
    rows = [(KINDS[p.kind], p.a, p.b, p.c1, p.c2, p.c1 + p.b) for p in parts]
    kind, a, b, c1, c2, last = np.array(rows, np.int64).reshape(-1, 6).T.copy()
    programs = compile_predicates([part.predicate for part in parts], places(task))
    return Rules(kind, a, b, c1, c2, last, programs, regions_of(task), initial_signals(task), 0.0)


def goals_of(rules: Rules) -> Ints:
    """The obligations that are not an `always`, in their order."""
    return np.flatnonzero(rules.kind != ALWAYS)


def initial_signals(task: Task) -> Floats:
    """The values that the signals hold before their first samples, shape (S,)."""
    return np.array(list(task.signals.values()), np.float64)


@inlined
def fill_place(regions: PackedRegions, x: float, y: float, theta: float, values: Floats) -> None:
    """Fills the pose and every region into `values` (rule/values.py); the signals are left as they are."""
    fill_pose(x, y, theta, values)
    for r in range(regions.plain.shape[0]):
        fill_region(regions, r, values)


@inlined
def fill_signals(regions: PackedRegions, signals: Floats, values: Floats) -> None:
    """Fills signals (S,) into `values`."""
    copy_row(signals, values[REGIONS + regions.plain.shape[0] :])


@leaf
def value_count(rules: Rules) -> int:
    return int(REGIONS + rules.regions.plain.shape[0] + rules.signals.shape[0])


@inlined
def read_predicates(
    rules: Rules, x: float, y: float, theta: float, values: Floats, stack: Floats, out: Floats
) -> None:
    """The robustness of each obligation's predicate at a pose, into `out`, shape (K,)."""
    fill_place(rules.regions, x, y, theta, values)
    fill_signals(rules.regions, rules.signals, values)
    for k in range(rules.kind.shape[0]):
        out[k] = evaluate_packed(k, rules.programs, values, stack)


@inlined
def advance(rules: Rules, t: int, predicates: Floats, status: Int8s, run: Ints) -> None:
    """Takes the state at step t into the progress, in place.

    predicates (K,) at x_t; status (K,): PENDING, SETTLED or BROKEN; run (K,): how many steps, this one
    included, an eventually-always predicate has held without a break since its earliest window could begin.
    """
    for k in range(rules.kind.shape[0]):
        if status[k] != PENDING:
            continue
        holds = predicates[k] > rules.margin
        if rules.kind[k] == EVENTUALLY:
            if holds and rules.a[k] <= t <= rules.b[k]:
                status[k] = SETTLED
            elif t >= rules.b[k]:
                status[k] = BROKEN
        elif rules.kind[k] == ALWAYS:
            if not holds and rules.a[k] <= t <= rules.b[k]:
                status[k] = BROKEN
            elif t >= rules.b[k]:
                status[k] = SETTLED
        else:
            # F[a,c1] G[c2,b]: the predicate holds on [s + c2, s + b] for some witness time s in [a, c1].
            run[k] = run[k] + 1 if holds and t >= rules.a[k] + rules.c2[k] else 0
            if run[k] > rules.b[k] - rules.c2[k] and t >= rules.a[k] + rules.b[k]:
                status[k] = SETTLED
            elif t + 1 - run[k] > rules.c1[k] + rules.c2[k]:
                status[k] = BROKEN


@kernel
def replay(rules: Rules, past: float, poses: Floats, signals: Floats) -> tuple[Int8s, Ints]:
    """The progress, status and run (K,), after the states x_0..x_t, by the margin `past`. poses (t + 1, 3),
    signals (t + 1, S).

    Overwritten: rules.signals, which is left at the last row: the values that are held.
    """
    count = rules.kind.shape[0]
    status, run = np.full(count, PENDING, np.int8), np.zeros(count, np.int64)
    values, stack, predicates = np.empty(value_count(rules)), np.empty(STACK_SIZE), np.empty(count)
    for t in range(poses.shape[0]):
        copy_row(signals[t], rules.signals)
        read_predicates(rules, poses[t, 0], poses[t, 1], poses[t, 2], values, stack, predicates)
        if past != rules.margin:  # which `advance` goes by
            for k in range(predicates.shape[0]):
                predicates[k] = np.inf if predicates[k] > past else -np.inf
        advance(rules, t, predicates, status, run)
    return status, run


@kernel
def recall(rules: Rules, past: Past) -> Present:
    """As `replay`, but by the margin of `past`, which may be another than that of the rules.

    If it is the same, an obligation that can no longer be kept by the margin counts by margin 0, since J does
    not ask it for more. If it is another, a dwell that has begun counts only the steps that keep the rules'
    margin, which J asks of every step of a dwell, unless it is too late to begin the dwell anew.
    """
    margin, poses, signals = past
    status, run = replay(rules, margin, poses, signals)
    if margin != rules.margin:
        asked, whole = replay(rules, rules.margin, poses, signals)
        for k in range(status.shape[0]):
            if status[k] == PENDING and asked[k] == PENDING:
                run[k] = whole[k]
    elif margin > 0.0:
        had, whole = replay(rules, 0.0, poses, signals)
        for k in range(status.shape[0]):
            if status[k] == BROKEN:
                status[k], run[k] = had[k], whole[k]
    return Present(poses.shape[0] - 1, poses[-1], status, run)


@kernel
def resume(rules: Rules, past: Past) -> Present:
    """As `recall`, with `forgive` applied to what broke by x_t."""
    now = recall(rules, past)
    forgive(rules, now.t, now.status)
    return now


def pasts(rules: Rules, poses: Floats, signals: Floats) -> list[Past]:
    """The states x_0..x_t, with each margin for which a proposal has to be made.

    J asks that a past visit has the rules' margin if the visit can be made again, else any visit counts. If
    both may apply, a proposal is made for each.
    """
    less = rules.margin > 0.0 and _fall_short(rules, poses, signals)
    return [Past(margin, poses, signals) for margin in ([rules.margin, 0.0] if less else [rules.margin])]


@kernel
def _fall_short(rules: Rules, poses: Floats, signals: Floats) -> bool:
    """Whether x_0..x_t settled an obligation by less than the rules' margin, which it could still get."""
    asked, _ = replay(rules, rules.margin, poses, signals)
    status, _ = replay(rules, 0.0, poses, signals)
    less = False
    for k in range(status.shape[0]):
        less = less or (asked[k] != BROKEN and asked[k] != status[k])
    return less


@leaf
def forgive(rules: Rules, t: int, status: Int8s) -> None:
    """Lets a policy go on after something broke at step t, in place: an `always` whose window is not over is
    pending again, and any other broken obligation counts as settled.
    """
    for k in range(rules.kind.shape[0]):
        if status[k] == BROKEN:
            again = rules.kind[k] == ALWAYS and rules.b[k] > t
            status[k] = PENDING if again else SETTLED


def residuals(formula: Formula, prefix: Mapping[str, Floats], t: int) -> Iterator[Formula]:
    """What can be kept after a prefix that violates the formula, the most demanding choice first.

    prefix {name: [t + 1]}. The first choice drops the broken conjuncts and enforces a broken G again from
    step t + 1 on. The second leaves those G out, for a robot that is still inside what they forbid. A choice
    without any conjunct is not yielded.
    """
    kept, broken = left_over(formula, prefix, t)
    if broken:
        yield all_of([*kept, *again(broken, t + 1)])
    if kept:
        yield all_of(kept)
