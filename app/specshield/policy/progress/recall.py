"""The progress that a policy plans with: what the past has settled for a margin, and what is left to do once
an obligation is broken.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import NamedTuple

from specshield.arrays import Floats, Int8s, Ints
from specshield.caution.residual import again, all_of, left_over
from specshield.compiled import kernel, leaf
from specshield.policy.progress import ALWAYS, BROKEN, PENDING, SETTLED, Rules, replay
from specshield.stl import Formula


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
