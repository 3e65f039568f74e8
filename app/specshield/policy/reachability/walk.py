"""Following the tables uphill, and following a way already found: one continuation, a motion at a time.

The tables propose, exact simulation decides: every pose here comes from f, every settled obligation from
its predicate. These run once a motion in every decision, so they allocate nothing: see `Work`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from specshield.compiled import inlined, leaf
from specshield.policy.detour import join
from specshield.policy.reachability.tables import HOPELESS, goals_settled, is_broken, score, slack
from specshield.policy.reachability.work import Guide, Work, fill, is_over, look, observe, predicate_at
from specshield.robot.dynamics import step
from specshield.rule.progress import ALWAYS, EVENTUALLY, EVENTUALLY_ALWAYS, PENDING, SETTLED, Rules, advance

PATIENCE = 5  # steps without gain after which the walk is taken to go round in a circle
NUDGE = 0.02  # [m] a move that contact cuts shorter than this leads nowhere
DEEP = 0.2  # [m] inside a goal: robust enough
DEEPER = 0.01  # [m] by which a step has to lead deeper
SPARE = 10.0  # [steps] of slack above which some are spent on going deeper
TIE = 0.5  # [steps] by which a motion has to be better than waiting, where waiting pays
FAILED, SETTLED_ALL, STUCK = 0, 1, 2


@leaf
def walk(
    guide: Guide,
    t: int,
    n: int,
    motions: NDArray[np.int64],
    poses: NDArray[np.float64],
    work: Work,
) -> tuple[int, int]:
    """Follows the latest feasible time uphill to the horizon, on from motions[:n], n >= 1.

    motions (T - t,), poses (T - t, 3): written from n on. work.status, work.run: the progress at poses[n -
    1], taken along. Returns SETTLED_ALL where every goal was settled and nothing broken, STUCK where the
    tables led it round in a circle, and then how many steps there are to where the latest feasible time was
    highest; else FAILED.
    """
    body, rules, tables, wait = guide
    steps, last_phase, k_count = motions.shape[0], len(tables.end) - 1, rules.kind.shape[0]
    status, run, scores = work.status, work.run, work.scores
    x, y, theta = poses[n - 1, 0], poses[n - 1, 1], poses[n - 1, 2]
    high, high_n = -np.inf, n
    while n < steps and not is_over(rules, tables, t + n, status):
        last = motions[n - 1]
        score(body, rules, tables, x, y, theta, t + n, status, run, wait, last, scores)
        gained = n == high_n or scores[wait] > high + 0.25
        for k in range(k_count):
            gained = gained or status[k] != work.high_status[k]
        if gained:
            high, high_n = scores[wait], n
            _copy(status, run, work.high_status, work.high_run)
        elif n - high_n >= PATIENCE:
            return STUCK, high_n
        phase = tables.phase[t + n + 1]
        chosen, goal = -1, -1
        while True:
            best = wait
            for m in range(scores.shape[0]):
                if scores[m] > scores[best]:
                    best = m
            if scores[wait] > HOPELESS and scores[wait] > scores[best] - TIE:
                waits_for_phase = phase < last_phase and scores[wait] >= tables.end[phase] - 0.1
                goal = _pays_to_wait(rules, t + n, x, y, theta, work)
                if waits_for_phase or goal >= 0:
                    break
                scores[wait] = HOPELESS
                continue
            if scores[best] <= HOPELESS:
                break
            nx, ny, nth = step(body, x, y, theta, best)
            leads = abs(nx - x) + abs(ny - y) > NUDGE or nth != theta
            if leads and _keeps(rules, t + n + 1, nx, ny, nth, work):
                chosen = best
                x, y, theta = nx, ny, nth
                break
            scores[best] = HOPELESS
        if chosen >= 0:
            goal = _advance(rules, t + n + 1, work)
            motions[n] = chosen
            poses[n, 0], poses[n, 1], poses[n, 2] = x, y, theta
            n += 1
            if goal >= 0:  # settled: where there is time, by more than a little
                spare = slack(body, rules, tables, x, y, theta, t + n, status, run) - SPARE
                n = _deepen(guide, t, n, goal, min(rules.b[goal], t + n + spare), motions, poses, work)
                x, y, theta = poses[n - 1, 0], poses[n - 1, 1], poses[n - 1, 2]
            continue
        if goal >= 0 and rules.kind[goal] == EVENTUALLY:
            before = n
            n = _deepen(guide, t, n, goal, rules.a[goal], motions, poses, work)
            if n > before:
                x, y, theta = poses[n - 1, 0], poses[n - 1, 1], poses[n - 1, 2]
                continue
        # Waiting is best until something it brings about changes the progress.
        pending = _pending(status)
        look(rules, x, y, theta, work)
        while n < steps:
            advance(rules, t + n + 1, work.predicates, status, run)
            motions[n] = wait
            poses[n, 0], poses[n, 1], poses[n, 2] = x, y, theta
            n += 1
            if _pending(status) != pending or n == steps or tables.phase[t + n + 1] != phase:
                break
        if is_broken(status):
            break
        high_n = n  # waiting is no circle: what comes next counts anew
    fill(n, wait, x, y, theta, motions, poses)
    return (SETTLED_ALL if goals_settled(rules, status) else FAILED), n


@inlined
def _copy(
    status: NDArray[np.int8], run: NDArray[np.int64], to_status: NDArray[np.int8], to_run: NDArray[np.int64]
) -> None:
    for k in range(status.shape[0]):
        to_status[k], to_run[k] = status[k], run[k]


@inlined
def _pending(status: NDArray[np.int8]) -> int:
    count = 0
    for k in range(status.shape[0]):
        count += status[k] == PENDING
    return count


@inlined
def _keeps(rules: Rules, t: int, x: float, y: float, theta: float, work: Work) -> bool:
    """Whether being at a pose at step t breaks nothing. Leaves its predicates in work, the progress alone."""
    for k in range(rules.kind.shape[0]):
        kind = rules.kind[k]
        opens = rules.a[k] + (rules.c2[k] if kind == EVENTUALLY_ALWAYS else 0)
        if work.status[k] != PENDING or t < opens:
            continue
        work.predicates[k] = predicate_at(rules, k, x, y, theta, work)
        if work.predicates[k] > rules.margin:
            continue
        if kind == ALWAYS:
            if t <= rules.b[k]:
                return False
        elif kind == EVENTUALLY_ALWAYS:
            if t + 1 > rules.c1[k] + rules.c2[k]:
                return False
        elif t >= rules.b[k]:
            return False
    return True


@inlined
def _pays_to_wait(rules: Rules, t: int, x: float, y: float, theta: float, work: Work) -> int:
    """A goal that holds here and is still to open, or a dwell to go on; -1 if none."""
    for k in range(rules.kind.shape[0]):
        useful = rules.kind[k] == EVENTUALLY_ALWAYS or (rules.kind[k] != ALWAYS and rules.a[k] > t)
        if useful and work.status[k] == PENDING and predicate_at(rules, k, x, y, theta, work) > rules.margin:
            return k
    return -1


@inlined
def _advance(rules: Rules, t: int, work: Work) -> int:
    """`advance` with work's predicates; returns an F that it settles, -1 if none."""
    pending = 0
    for k in range(rules.kind.shape[0]):
        if rules.kind[k] == EVENTUALLY and work.status[k] == PENDING:
            pending |= 1 << k
    advance(rules, t, work.predicates, work.status, work.run)
    for k in range(rules.kind.shape[0]):
        if pending >> k & 1 and work.status[k] == SETTLED:
            return k
    return -1


@leaf
def _deepen(
    guide: Guide,
    t: int,
    n: int,
    goal: int,
    until: float,
    motions: NDArray[np.int64],
    poses: NDArray[np.float64],
    work: Work,
) -> int:
    """Repeats the last of motions[:n] for as long as it leads deeper into a goal, to DEEP and to step `until`
    at most; returns how many motions there are then."""
    body, rules, _, _ = guide
    x, y, theta = poses[n - 1, 0], poses[n - 1, 1], poses[n - 1, 2]
    depth = predicate_at(rules, goal, x, y, theta, work)
    while n < motions.shape[0] and t + n < until and depth < DEEP:
        x, y, theta = step(body, x, y, theta, motions[n - 1])
        deeper = predicate_at(rules, goal, x, y, theta, work)
        if deeper < depth + DEEPER or not _keeps(rules, t + n + 1, x, y, theta, work):
            break
        advance(rules, t + n + 1, work.predicates, work.status, work.run)
        motions[n], depth = motions[n - 1], deeper
        poses[n, 0], poses[n, 1], poses[n, 2] = x, y, theta
        n += 1
    return n


@leaf
def rejoin(
    guide: Guide,
    t: int,
    turn: int,
    move: int,
    base: NDArray[np.int64],
    led: NDArray[np.float64],
    at: int,
    motions: NDArray[np.int64],
    poses: NDArray[np.float64],
    work: Work,
) -> bool:
    """Goes on from motions[:1] by `turn` and `move`, then by `base`, a way to every goal, as `join` has it.

    led (T - t, 3): where `base` led, which need not be found again from the very same pose. To be on its way
    only nearly may do: the result says whether every goal was settled. Other arguments as in `walk`.
    """
    body, rules, tables, wait = guide
    join(turn, move, base, at, wait, motions)
    x, y, theta = poses[0, 0], poses[0, 1], poses[0, 2]
    n, looked, joined = 1, False, 1 + (turn >= 0) + (move >= 0)
    while n < motions.shape[0] and not is_over(rules, tables, t + n, work.status):
        if is_broken(work.status):
            break
        if motions[n] != wait:
            known = False
            if n >= joined:  # `base` has the same motions in the same order, waits apart
                while base[at] == wait:
                    at += 1
                known = at > 0 and led[at - 1, 0] == x and led[at - 1, 1] == y and led[at - 1, 2] == theta
                at += 1
            if known:
                x, y, theta = led[at - 1, 0], led[at - 1, 1], led[at - 1, 2]
            else:
                x, y, theta = step(body, x, y, theta, motions[n])
            observe(rules, t + n + 1, x, y, theta, work)
            looked = False
        else:
            if not looked:
                look(rules, x, y, theta, work)
            looked = True
            advance(rules, t + n + 1, work.predicates, work.status, work.run)
        poses[n, 0], poses[n, 1], poses[n, 2] = x, y, theta
        n += 1
    fill(n, wait, x, y, theta, motions, poses)
    return goals_settled(rules, work.status)
