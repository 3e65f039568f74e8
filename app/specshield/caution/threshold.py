"""A threshold for the whole episode: delta bounds the probability that the rule is kept, not one step's.

V(a) is a lower bound on the probability of keeping the rule after a, V* the largest of them, d_0 = delta, and

    pi_t = the distribution nearest to the model's with E_pi[V] >= d_t,    d_{t+1} = d_t V*_{t+1} / E_pi_t[V].

If V(a) is never above the expected V* of the next step, then E[d_{t+1}] >= d_t, and d_t <= V*_t; so the rule
is kept with probability delta or more. In an exact world, without margin and slack, V is J, 0 or 1.

If motions differ from f, V(a) is the probability that the best future after a withstands slips and noise
(docs/uncertainty.md): a lower bound with slips alone, an estimate with noise.
"""

from __future__ import annotations

import math

import numpy as np

from specshield.arrays import Bools, Floats, Ints, copy_row
from specshield.caution.early import Conjuncts, conjunction_of, find_open
from specshield.caution.judgement import Judged
from specshield.caution.noise import Care, Noise, above, spread_of
from specshield.compiled import Boxed, kernel, leaf
from specshield.portable import inner
from specshield.robot.body import Body, centre, displacement
from specshield.robot.contact import free_distance
from specshield.shield.certificate import Witnesses
from specshield.shield.decision import Carry, Shield
from specshield.shield.feasibility import Prefix, rho_of
from specshield.stl import SATISFIED_ABOVE
from specshield.stl.tree import ALWAYS, EVENTUALLY, tree_value

GRID = 100  # V is rounded down to a multiple of 1 / GRID, so that actions which are nearly as good are equal

# Longer delays, chosen by hand beside what `python -m benchmarks.lateness` prints: how often a motion has
# one, for each step of `spread_of` [1 / step], and how long it lasts in the mean [steps].
HELD_UP, FOR = 0.04, 5.0
SHARP, STOPS = 1.5, 0.5  # [rad] if no turn is smaller, this share of contacts ends a robot's way. By hand.
MOST_SLIPS, UNLIKELY = 64, 1e-9  # more slips of one future, or less probable ones, are not counted. By hand.


def chances(
    shield: Shield, care: Care, prefix: Prefix, judged: Judged, doubts: Bools, certified: Witnesses
) -> tuple[Floats, Witnesses]:
    """V of each action [A], 0 for a terminal one; and what follows each motion in the future that shows its
    V, unless the motion is `certified` and has its witness already. doubts [M]: motions that get V = 0 if
    they are not feasible while others are, though some future of theirs may keep the rule.
    """
    tried, task = judged.tried, shield.task
    view, parts = conjunction_of(task, prefix.formula)
    leaves, motion_of = tried.leaves, task.robot.motion_of
    if view is not None:
        prefix = prefix.of(prefix.formula, view)
        _, leaves = rho_of(prefix, tried.poses)
    rho = np.where(judged.kept > SATISFIED_ABOVE, tried.rho, -np.inf)  # futures set aside do not count
    still, values = np.empty(len(parts.value.kind), np.bool_), np.zeros(len(task.robot.motions))
    shown = np.zeros(len(values), np.int64)
    any_visit, settled = np.full(len(still), SATISFIED_ABOVE), np.empty(len(still))
    find_open(parts, prefix.known, prefix.t, any_visit, still, settled)
    blunt = all(abs(turn) >= SHARP for _, turn in task.robot.motions if turn != 0.0)
    body, ways = (shield.body, blunt), (leaves, rho, tried.motions, tried.poses, task.robot.wait_motion)
    _chances(parts, still, prefix.t, body, (care.noise, care.stride, care.margin), *ways, values, shown)
    if judged.some:
        values[doubts & ~judged.feasible_motion] = 0.0
    onward = tuple(  # an action with a chance has to have it at the next step too, certified or not
        bytes(tried.motions[f, 1:].tolist()) if way is None and value > 0.0 else way
        for way, value, f in zip(certified, values.tolist(), shown.tolist(), strict=True)
    )
    return np.where(motion_of >= 0, np.floor(GRID * values)[motion_of] / GRID, 0.0), onward


@kernel
def _chances(
    boxed: Boxed[Conjuncts],
    still: Bools,
    t: int,
    robot: tuple[Body, bool],
    care: tuple[Noise, float, float],
    leaves: Floats,
    rho: Floats,
    motions: Ints,
    poses: Floats,
    wait: int,
    values: Floats,
    shown: Ints,
) -> None:
    """Writes V of each motion's best future into values (M,), which hold 0, and the future's row into shown
    (M,). still (K,): what is open. robot: its body, and whether it has no turn below SHARP. care: the noise,
    stride and margin of the `Care`.
    """
    parts, (body, blunt), (noise, stride, margin) = boxed.value, robot, care
    count, spread = still.shape[0], spread_of(noise, stride)
    sigma = math.hypot(noise.move, stride * noise.turn)
    buffer, late = np.empty(leaves.shape[1]), np.empty((MOST_SLIPS + 1, MOST_SLIPS + 2))
    due = np.empty((count, 3), np.int64)
    for f in range(rho.shape[0]):
        if not rho[f] > SATISFIED_ABOVE:
            continue
        copy_row(leaves[f], buffer)
        tree_value(parts.below, buffer)
        chance, dwells, last, made = 1.0, 0, 0, 0
        for k in range(count):
            due[k, 0] = 0
            if not still[k]:
                continue
            due[k, 0], due[k, 1], due[k, 2] = _deadline(parts, k, t, margin, buffer)
            last = max(last, due[k, 0])
            if parts.kind[k] == EVENTUALLY and parts.horizon[k] > 0:
                dwells = max(dwells, due[k, 0])
            if not parts.plain[k] and (noise.slips > 0.0 or spread > 0.0):
                chance = 0.0
            if sigma > 0.0 and parts.kind[k] == ALWAYS:
                for step in range(max(parts.a[k], t + 1 - parts.horizon[k]), parts.b[k] + 1):
                    deep = max(buffer[parts.at[k] + step - parts.a[k]], 0.0)
                    chance *= 1.0 - math.exp(-0.5 * (deep / sigma) ** 2)
        for n in range(last if blunt and sigma > 0.0 else 0):
            made += motions[f, n] != wait
            if displacement(body, motions[f, n])[0] != 0.0:
                off = sigma * math.sqrt(made)  # how far noise leads off a way if nothing mends it
                u, v = centre(body, poses[f, n, 0], poses[f, n, 1], poses[f, n, 2])
                room = free_distance(body, u, v, body.radius + 4.0 * off) - body.radius
                chance *= math.exp(-STOPS * above(max(room, 0.0), off))
        if chance > 0.0 and (noise.slips > 0.0 or spread > 0.0):
            never = _in_time(noise, spread, False, due, motions[f, :last], wait, dwells, late)
            slips = _in_time(noise, spread, True, due, motions[f, :last], wait, dwells, late)
            chance *= (1.0 - noise.slips) * never + noise.slips * slips
        if chance > values[motions[f, 0]]:
            values[motions[f, 0]], shown[motions[f, 0]] = chance, f


@leaf
def _deadline(parts: Conjuncts, k: int, t: int, margin: float, buffer: Floats) -> tuple[int, int, int]:
    """The deadline of conjunct k along a future: after how many motions the robot is where it has to be, 0
    for no deadline; how many steps later it may be there; and in how many steps from t the deadline is.

    An F counts from the first step that meets it by `margin`, or meets it at all if none does. A G that has
    begun has no deadline. buffer (size,): the values of the leaves along the future.
    """
    a, b, first, met = parts.a[k], parts.b[k], parts.at[k] - parts.a[k], -1
    if parts.kind[k] == EVENTUALLY:
        for step in range(a, b + 1):
            if buffer[first + step] > SATISFIED_ABOVE + margin:
                met = step
                break
            if met < 0 and buffer[first + step] > SATISFIED_ABOVE:
                met = step
        last = parts.horizon[k] - t
        return met + last, b - met, b + last
    if a <= t:
        return 0, 0, 0
    met = a
    while met > (t if parts.lead[k] > 0 else a) and buffer[first + met - 1] > SATISFIED_ABOVE + margin:
        met -= 1
    return met - t, a - met, a - t


@leaf
def _in_time(
    noise: Noise, spread: float, slips: bool, due: Ints, motions: Ints, wait: int, dwells: int, late: Floats
) -> float:
    """The probability that a robot which follows a future's motions (n,) meets all deadlines. It repeats
    a motion that was not executed and, if it is late, leaves out waits, but not among the first `dwells`.

    slips: whether motions slip. due (K, 3): results of `_deadline`. late (MOST_SLIPS + 1, MOST_SLIPS + 2):
    scratch; late[s, k] is the probability that s motions slipped and the robot is k steps late, but was in
    time for all that was due before. More slips than MOST_SLIPS, and those less likely than UNLIKELY, count
    as too late. What noise costs is rounded to whole steps.
    """
    made, top = 0, 0  # top: the most slips that are likely
    late[0, :] = 0.0
    late[0, 0] = 1.0
    for n in range(1, motions.shape[0] + 1):
        if motions[n - 1] == wait:
            if n > dwells:
                for s in range(top + 1):
                    late[s, 0] += late[s, 1]
                    for k in range(1, s + 1):
                        late[s, k] = late[s, k + 1]
        elif slips:
            s = 0
            while s <= top:
                share, most = (noise.lost + s) / (noise.lost + noise.kept + s + made), 0.0
                if s == top and top < MOST_SLIPS:
                    late[s + 1, :] = 0.0
                for k in range(s + 1):
                    again = late[s, k] * share
                    late[s, k] -= again
                    if s < MOST_SLIPS:
                        late[s + 1, k + 1] += again
                    most = max(most, again)
                if s == top and top < MOST_SLIPS and most > UNLIKELY:
                    top += 1
                s += 1
            made += 1
        for c in range(due.shape[0]):
            if due[c, 0] == n:
                for k in range(top + 1):
                    spare, left = due[c, 1] - k, due[c, 2]
                    longer = HELD_UP * spread * left * math.exp(-spare / FOR)
                    in_time = (1.0 - above(spare + 0.5, spread * math.sqrt(left))) * math.exp(-longer)
                    for s in range(k, top + 1):
                        late[s, k] *= in_time
    return float(late[: top + 1].sum())


def left_of(shield: Shield, carry: Carry | None, values: Floats | None) -> float:
    """d_t / V*_t. values [A]: V, None if the step was not shaped."""
    if carry is not None and carry.threshold_left is not None:
        return carry.threshold_left
    best = 1.0 if values is None else float(values.max())
    return min(shield.config.threshold / best, 1.0) if best > 0.0 else 1.0


def next_left(left: float, values: Floats, distribution: Floats, terminal: Bools) -> float:
    """d_{t+1} / V*_{t+1}; left: d_t / V*_t. In place of a terminal action the best one is executed."""
    best = float(values.max())
    expected = float(inner(distribution, np.where(terminal, best, values)))
    return min(left * best / expected, 1.0) if expected > 0.0 else left
