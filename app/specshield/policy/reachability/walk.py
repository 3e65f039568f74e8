"""One continuation, a motion at a time: by climbing the latest feasible times, or along a way already found.

The tables only suggest a motion. Every pose comes from f, and an obligation counts as settled only when its
predicate says so. This runs once for each first motion of each decision, so nothing here allocates.
"""

from __future__ import annotations

import numpy as np

from specshield.arrays import Floats, Int8s, Ints
from specshield.caution.surprise.barred import is_barred
from specshield.compiled import inlined, leaf
from specshield.policy.lattice import leads_on
from specshield.policy.progress import ALWAYS, EVENTUALLY, EVENTUALLY_ALWAYS, PENDING, SETTLED, Rules, advance
from specshield.policy.reachability.guide import copy_progress, fill, is_over, predicate_at, read_due
from specshield.policy.reachability.tables import (
    HOPELESS,
    SAFE,
    Guide,
    Scratch,
    goals_settled,
    is_broken,
    score,
    slack,
)
from specshield.robot.dynamics import step

# Chosen by hand; nothing measured.
STUCK_AFTER = 5  # [steps] without a gain after which a climb is taken to go round in a circle
CLIMB_GAIN = 0.25  # [steps] later than ever before: what counts as a gain
DEPTH_WANTED = 0.2  # [m] how far inside a goal is deep enough, where there is time to go deeper
DEPTH_GAIN = 0.01  # [m] by which each step has to lead deeper
SPARE = 10.0  # [steps] of slack that are not spent on going deeper
TIE = 0.5  # [steps] by which a motion has to be better than waiting, where waiting is of use
PHASE_END = 0.1  # [steps] a latest time as near as this to its phase's end is that end

FAILED, SETTLED_ALL, STUCK = 0, 1, 2


@leaf
def climb(
    guide: Guide, t: int, n: int, motions: Ints, poses: Floats, scratch: Scratch, patient: bool
) -> tuple[int, int]:
    """Goes on from motions[:n], n >= 1, to the horizon, by the motion with the latest feasible time.

    motions (T - t,) and poses (T - t, 3) are written from n on. The scratch holds the progress at
    poses[n - 1], which is taken along. Returns SETTLED_ALL where every goal was settled and nothing broken;
    STUCK where the tables led round in a circle, with the number of motions to where the latest feasible time
    was highest; else FAILED. patient: where no motion leads on, it waits for another phase; else that is
    STUCK too.
    """
    body, rules, tables, wait, _ = guide
    steps, last_phase, k_count = motions.shape[0], len(tables.end) - 1, rules.kind.shape[0]
    status, run, scores = scratch.status, scratch.run, scratch.scores
    x, y, theta = poses[n - 1, 0], poses[n - 1, 1], poses[n - 1, 2]
    high, high_n = -np.inf, n
    while n < steps and not is_over(rules, tables, t + n, status):
        score(guide, x, y, theta, t + n, motions[n - 1], (0, 1), scratch)
        gained = n == high_n or scores[wait] > high + CLIMB_GAIN
        for k in range(k_count):
            gained = gained or status[k] != scratch.high_status[k]
        if gained:
            high, high_n = scores[wait], n
            copy_progress(status, run, scratch.high_status, scratch.high_run)
        elif n - high_n >= STUCK_AFTER:
            return STUCK, high_n
        phase = tables.phase[t + n + 1]
        chosen, goal, waits_for_phase, looked = -1, -1, False, False
        while True:
            best = wait
            for m in range(scores.shape[0]):
                if scores[m] > scores[best]:
                    best = m
            if scores[wait] > HOPELESS and scores[wait] > scores[best] - TIE:
                waits_for_phase = phase < last_phase and scores[wait] >= tables.end[phase] - PHASE_END
                if waits_for_phase and not looked:
                    ready, looked = _readier(guide, t + n, x, y, theta, scratch), True
                    if ready >= 0:
                        scores[ready] = SAFE
                        continue
                goal = _pays_to_wait(rules, t + n, x, y, theta, scratch)
                if waits_for_phase or goal >= 0:
                    break
                scores[wait] = HOPELESS
                continue
            if scores[best] <= HOPELESS:
                break
            nx, ny, nth = step(body, x, y, theta, best)
            leads = leads_on(body, best, x, y, theta, (nx, ny, nth))
            leads = leads and not is_barred(guide.barred, x, y, theta, best)
            if leads and _keeps(rules, t + n + 1, nx, ny, nth, scratch):
                chosen = best
                x, y, theta = nx, ny, nth
                break
            scores[best] = HOPELESS
        if chosen >= 0:
            goal = _advance(rules, t + n + 1, scratch)
            motions[n] = chosen
            poses[n, 0], poses[n, 1], poses[n, 2] = x, y, theta
            n += 1
            high_n = n if looked else high_n  # it has time, and is not stuck
            if goal >= 0:  # it is settled; where there is time, the robot goes deeper into it
                spare = slack(guide, x, y, theta, t + n, scratch) - SPARE
                n = _deepen(guide, t, n, goal, min(rules.b[goal], t + n + spare), motions, poses, scratch)
                x, y, theta = poses[n - 1, 0], poses[n - 1, 1], poses[n - 1, 2]
            continue
        if goal >= 0 and rules.kind[goal] == EVENTUALLY:
            before = n
            n = _deepen(guide, t, n, goal, float(rules.a[goal]), motions, poses, scratch)
            if n > before:
                x, y, theta = poses[n - 1, 0], poses[n - 1, 1], poses[n - 1, 2]
                continue
        if not (patient or waits_for_phase or goal >= 0):
            return STUCK, high_n
        # Waiting stays best until it changes the progress, or the phase ends.
        pending = _pending(status)
        read_due(rules, t + steps, x, y, theta, scratch)
        while n < steps:
            advance(rules, t + n + 1, scratch.predicates, status, run)
            motions[n] = wait
            poses[n, 0], poses[n, 1], poses[n, 2] = x, y, theta
            n += 1
            if _pending(status) != pending or n == steps or tables.phase[t + n + 1] != phase:
                break
        if is_broken(status):
            break
        high_n = n  # a robot that waits is not stuck
    fill(n, wait, motions, poses)
    return (SETTLED_ALL if goals_settled(rules, status) else FAILED), n


@inlined
def _pending(status: Int8s) -> int:
    count = 0
    for k in range(status.shape[0]):
        count += status[k] == PENDING
    return count


@inlined
def _keeps(rules: Rules, t: int, x: float, y: float, theta: float, scratch: Scratch) -> bool:
    """Whether a pose at step t breaks nothing. Leaves its predicates in the scratch, and the progress."""
    for k in range(rules.kind.shape[0]):
        kind = rules.kind[k]
        if scratch.status[k] != PENDING or t < rules.a[k] + rules.c2[k]:
            continue
        scratch.predicates[k] = predicate_at(rules, k, x, y, theta, scratch)
        if scratch.predicates[k] > rules.margin:
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


@leaf
def _readier(guide: Guide, t: int, x: float, y: float, theta: float, scratch: Scratch) -> int:
    """The motion after which the next G to begin holds by the most, if there is time for it; -1 to stay."""
    chosen, deepest = -1, _readiness(guide.rules, t, x, y, theta, scratch) + DEPTH_GAIN
    for m in range(scratch.scores.shape[0] if deepest < DEPTH_WANTED else 0):
        nx, ny, nth = step(guide.body, x, y, theta, m)
        ready = _readiness(guide.rules, t, nx, ny, nth, scratch) if scratch.scores[m] >= t + 1 else -np.inf
        if ready > deepest and _keeps(guide.rules, t + 1, nx, ny, nth, scratch):
            chosen, deepest = m, ready
    return chosen


@inlined
def _readiness(rules: Rules, t: int, x: float, y: float, theta: float, scratch: Scratch) -> float:
    least, begins = np.inf, np.inf
    for k in range(rules.kind.shape[0]):
        if rules.kind[k] == ALWAYS and t + 1 < rules.a[k] <= begins:
            depth = predicate_at(rules, k, x, y, theta, scratch)
            least, begins = min(least, depth) if rules.a[k] == begins else depth, float(rules.a[k])
    return least


@inlined
def _pays_to_wait(rules: Rules, t: int, x: float, y: float, theta: float, scratch: Scratch) -> int:
    """A goal that holds here and whose window is still to open, or a dwell under way; -1 for none."""
    for k in range(rules.kind.shape[0]):
        useful = rules.kind[k] == EVENTUALLY_ALWAYS or (rules.kind[k] != ALWAYS and rules.a[k] > t)
        useful = useful and scratch.status[k] == PENDING
        if useful and predicate_at(rules, k, x, y, theta, scratch) > rules.margin:
            return k
    return -1


@inlined
def _advance(rules: Rules, t: int, scratch: Scratch) -> int:
    """Advances the progress by the scratch's predicates; returns an F that this settles, -1 for none."""
    pending = 0
    for k in range(rules.kind.shape[0]):
        if rules.kind[k] == EVENTUALLY and scratch.status[k] == PENDING:
            pending |= 1 << k
    advance(rules, t, scratch.predicates, scratch.status, scratch.run)
    for k in range(rules.kind.shape[0]):
        if pending >> k & 1 and scratch.status[k] == SETTLED:
            return k
    return -1


@leaf
def _deepen(
    guide: Guide, t: int, n: int, goal: int, until: float, motions: Ints, poses: Floats, scratch: Scratch
) -> int:
    """Repeats the last of motions[:n] as long as it leads deeper into a goal, until DEPTH_WANTED or the step
    `until` is reached; returns how many motions there are then.
    """
    body, rules, _, _, _ = guide
    x, y, theta = poses[n - 1, 0], poses[n - 1, 1], poses[n - 1, 2]
    depth = predicate_at(rules, goal, x, y, theta, scratch)
    while n < motions.shape[0] and t + n < until and depth < DEPTH_WANTED:
        if is_barred(guide.barred, x, y, theta, motions[n - 1]):
            break
        x, y, theta = step(body, x, y, theta, motions[n - 1])
        deeper = predicate_at(rules, goal, x, y, theta, scratch)
        if deeper < depth + DEPTH_GAIN or not _keeps(rules, t + n + 1, x, y, theta, scratch):
            break
        advance(rules, t + n + 1, scratch.predicates, scratch.status, scratch.run)
        motions[n], depth = motions[n - 1], deeper
        poses[n, 0], poses[n, 1], poses[n, 2] = x, y, theta
        n += 1
    return n
