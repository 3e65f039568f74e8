"""Look-ahead: exact where the lattice is, vanishing where the model cannot be known, pure and repeatable."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest

from specshield.lookahead.belief import STYLE, Belief
from specshield.lookahead.desirability import UNKEEPABLE, desirability, solve
from specshield.lookahead.expansion import Bank, expand_all
from specshield.lookahead.goals import make_goals
from specshield.lookahead.lattice import blocked_at, make_planes
from specshield.lookahead.lookahead import FORCED, prepare
from specshield.lookahead.surrogate import WANDER, StandIn, end_chance, follow, price_left, step_price
from specshield.policy.progress import make_rules
from specshield.robot import STRETCH
from specshield.robot.dynamics import make_body, step
from specshield.shield.shaping import log_softmax, restrict
from specshield.world.occupancy import OccupancyGrid
from tests.oracles.cells import MOTIONS, STATES, Cells
from tests.policy.rooms import flat

WORLD = Cells(
    "F[0,4] A and F[5,9] B and G[0,9] not C",
    lambda s: s["A"][..., :5].any(-1) & s["B"][..., 5:10].any(-1) & ~s["C"].any(-1),
    {"A": (1, 0), "B": (0, 2), "C": (0, 3)},
)
HORIZON = 9


def model(random):
    """A model on the cells: motion probabilities [states, M] and the chance of an end [states]."""
    logits = random.normal(0, 1.5, (len(STATES), MOTIONS))
    weights = np.exp(logits)
    return weights / weights.sum(axis=1, keepdims=True), random.uniform(0.0, 0.2, len(STATES))


def settled(mask, state, t):
    """The goals A and B settled at t, None where C breaks the rule: the formula written again."""
    cell = STATES[state][:2]
    if cell == WORLD.regions["C"]:
        return None
    mask |= cell == WORLD.regions["A"] and t <= 4
    return mask | 2 * (cell == WORLD.regions["B"] and 5 <= t <= 9)


def exact(r, e, price, left):
    """The least KL of a path that keeps the rule, {(t, mask): [states]}; what comes after an end is free.

    price: of a step while A or B is not settled; left [states]: of being where the last of them is.
    """
    found = {(HORIZON, m): np.where(m == 3, 0.0, np.inf) * np.ones(len(STATES)) for m in range(4)}
    for t, mask in itertools.product(reversed(range(HORIZON)), range(4)):
        values = np.full(len(STATES), np.inf)
        for s in range(len(STATES)):
            weight = 0.0
            for m in range(MOTIONS):
                after = int(WORLD.table[s, m])
                then = settled(mask, after, t + 1)
                if then is not None:
                    due = left[after] if then == 3 and mask != 3 else 0.0
                    weight += r[s, m] * np.exp(-found[t + 1, then][after] - due)
            due = price if mask != 3 else 0.0
            values[s] = due - (1.0 - e[s]) * np.log(weight) if weight > 0.0 else np.inf
        found[t, mask] = values
    return found


def solve_cells(r, e, price, left):
    """D of a model of the cells, which are the lattice's own."""
    planes = make_planes(WORLD.body, make_rules(WORLD.task), HORIZON, pitch=0.2)
    headings, cells = planes.valid.shape
    assert headings == 4
    motions, ends = np.zeros((MOTIONS, headings, cells), np.float32), np.zeros((headings, cells), np.float32)
    remaining = np.zeros(cells, np.float32)
    for s, (i, j, h) in enumerate(STATES):
        at = (j + planes.pad) * planes.width + i + planes.pad
        motions[:, h, at], ends[h, at], remaining[at] = np.log(r[s]), e[s], left[s]
    return planes, solve(planes, StandIn(motions, ends, price, remaining))


@pytest.mark.parametrize(("price", "slope"), [(0.0, 0.0), (0.5, 1.5)])
def test_desirability_is_exact_where_the_lattice_is(price, slope):
    r, e = model(np.random.default_rng(5))
    left = np.array([slope * (4 - i + j) for i, j, _ in STATES])
    planes, table = solve_cells(r, e, price, left)
    wanted, seen = exact(r, e, price, left), 0
    for t, mask in ((0, 0), (3, 0), (2, 1), (6, 1), (7, 3)):
        for s, state in enumerate(STATES):
            pose = WORLD.pose(*state)
            if not planes.valid[state[2]][(state[1] + planes.pad) * planes.width + state[0] + planes.pad]:
                continue
            found = desirability(planes, table, t, mask, *pose)
            if settled(mask, s, t) != mask or not np.isfinite(wanted[t, mask][s]):
                continue
            assert found == pytest.approx(wanted[t, mask][s], rel=0.03, abs=0.03)
            seen += 1
    assert seen > 100


@pytest.mark.parametrize("which", [0, -1, None])
def test_exact_steps_and_the_lattice_charge_alike(which):
    """A stand-in's D after each motion, two exact steps before the lattice, on the cells that are exact."""
    body, rules, goals = WORLD.body, make_rules(WORLD.task), make_goals(WORLD.body, WORLD.task.grid)
    lead = WANDER if which is None else range(len(goals.distance))[which]
    log_r = np.empty(MOTIONS)
    r, e, left = np.full((len(STATES), MOTIONS), 1 / MOTIONS), np.zeros(len(STATES)), np.zeros(len(STATES))
    free = [s for s, (i, j, _) in enumerate(STATES) if not body.occupied[j, i]]
    for s in free:
        pose = WORLD.pose(*STATES[s])
        e[s] = follow(goals, lead, STYLE, tuple(pose), blocked_at(body, *pose), log_r)
        r[s], left[s] = np.exp(log_r), price_left(goals, lead, *pose[:2])
    assert np.ptp(left) > 1.0 or lead != len(goals.distance) - 1
    planes, table = solve_cells(r, e, step_price(lead), left)
    wanted, seen = exact(r, e, step_price(lead), left), 0
    for t, mask, s in itertools.product(range(HORIZON), range(4), free):
        if settled(mask, s, t) != mask or planes.slot[t, mask] < 0:
            continue
        found, bank = np.empty((1, MOTIONS)), Bank(rules, goals, planes, np.array([lead]), table[None])
        expand_all(bank, np.array([0]), STYLE, t, mask, np.array(WORLD.pose(*STATES[s])), found)
        for m in range(MOTIONS):
            after = int(WORLD.table[s, m])
            then = settled(mask, after, t + 1)
            best = np.inf if then is None else wanted[t + 1, then][after]
            due = left[after] if then == 3 and mask != 3 else 0.0
            assert (found[0, m] < UNKEEPABLE) == np.isfinite(best)
            if np.isfinite(best):
                assert found[0, m] == pytest.approx(best + due, rel=0.03, abs=0.03)
                seen += 1
    assert seen > 1000


def test_the_way_that_is_left_has_a_price_round_walls_and_through_narrow_doors():
    """West of a wall with a door, in the open and beside another wall; steps of 0.2 m."""
    for door in ((18, 28), (20, 25)):  # 1 m, and 0.5 m: a Stretch cannot turn in it
        occupied = np.zeros((30, 40), bool)
        occupied[:, 20] = True
        occupied[slice(*door), 20] = False
        grid = OccupancyGrid(occupied, 0.1, (0.0, 0.0, 0.0))
        body = make_body(STRETCH, grid)
        goals = make_goals(body, grid)
        cells = np.array([np.argwhere(distance == 0)[0] for distance in goals.distance])
        goal = int(np.argmin(np.abs(cells - (4, 35)).sum(axis=1)))  # far corner, east
        x, y = 0.1 * (cells[goal][1] + 0.5), 0.1 * (cells[goal][0] + 0.5)
        for at in ((0.75, 0.75), (0.75, 0.15)):  # the second beside the lower wall
            through = math.hypot(2.05 - at[0], 2.1 - at[1]) + math.hypot(x - 2.05, y - 2.1)
            straight = math.hypot(x - at[0], y - at[1])
            assert (through - straight) / 0.2 > 4.0
            least = (through - 1.0) / 0.2  # corners are taken wider
            assert least - 0.5 <= price_left(goals, goal, *at) <= 1.2 * least
        assert price_left(goals, goal, x, y) == 0.0
        assert price_left(goals, WANDER, 0.75, 0.75) == 0.0


def test_following_it_costs_what_the_best_path_does():
    """Path KL of restrict(r exp(-D), S_t), worked out over all its ways, within 5 % of the least there is."""
    r, e = model(np.random.default_rng(5))
    free = np.zeros(len(STATES))
    planes, table = solve_cells(r, e, 0.0, free)
    wanted, checked = exact(r, e, 0.0, free), 0

    def cost(t, mask, s):
        if t == HORIZON:
            return 0.0
        left, feasible = np.full(MOTIONS, float(UNKEEPABLE)), np.zeros(MOTIONS, bool)
        for m in range(MOTIONS):
            after = int(WORLD.table[s, m])
            then = settled(mask, after, t + 1)
            if then is not None and np.isfinite(wanted[t + 1, then][after]):
                feasible[m] = True
                left[m] = desirability(planes, table, t + 1, then, *WORLD.pose(*STATES[after]))
        chosen = restrict(log_softmax(np.log(r[s]) - left), feasible)
        total = 0.0
        for m in np.flatnonzero(chosen > 0.0):
            after = int(WORLD.table[s, m])
            rest = memo(t + 1, settled(mask, after, t + 1), after)
            total += chosen[m] * (np.log(chosen[m] / r[s, m]) + rest)
        return (1.0 - e[s]) * total

    known = {}

    def memo(*key):
        if key not in known:
            known[key] = cost(*key)
        return known[key]

    for s in range(len(STATES)):
        mask = settled(0, s, 0)
        i, j, _ = STATES[s]
        if not WORLD.body.occupied[j, i] and mask is not None and np.isfinite(wanted[0, mask][s]):
            assert memo(0, mask, s) <= 1.05 * wanted[0, mask][s] + 1e-3
            checked += 1
    assert checked >= 8


SHARP_STYLE = (2.8, 2.8, -2.8, -1.0)
TASK = flat("F[0,30] West and F[30,60] East and G[0,60] not Hole")
ALL = np.ones(len(TASK.robot.actions), bool)


def advance(ahead, belief, *seen):
    """`LookAhead.step`, with what is believed in place of the memory."""
    memory, added = ahead.step(belief.to_bytes(), *seen)
    return Belief.from_bytes(memory, len(TASK.robot.motions)), added


def drive(speak, steps=25, start=(-0.4, 2.4, 0.2), forced=FORCED):
    """Beliefs and additions along the way of a model that is let go where it wants to.

    forced: what the rule is said to have cost before.
    """
    ahead, body = prepare(TASK), make_body(TASK.robot, TASK.grid)
    motions = len(TASK.robot.motions)
    belief = replace(Belief.from_bytes(ahead.begin(), motions), forced=forced)
    history, given = [np.array(start)], []
    random = np.random.default_rng(0)
    for t in range(steps):
        log_prior = log_softmax(speak(t, history[-1], random))
        belief, added = advance(ahead, belief, np.array(history), {}, log_prior, ALL)
        given.append((belief, added))
        weights = np.where(TASK.robot.terminal, 0.0, np.exp(log_prior))
        action = random.choice(len(weights), p=weights / weights.sum())
        history.append(np.array(step(body, *history[-1], int(TASK.robot.motion_of[action]))))
    return ahead, np.array(history), given


def seeks(goal):
    """What the surrogate itself would say with this goal, or WANDER, and a sharpness of its own."""
    goals = prepare(TASK).bank.goals

    def speak(t, pose, random):
        blocked = blocked_at(goals.body, *pose)
        log_r, style = np.empty(len(blocked)), np.array(SHARP_STYLE)
        end = follow(goals, goal, style, tuple(pose), blocked, log_r)
        of = TASK.robot.motion_of
        shares = np.bincount(of[~TASK.robot.terminal])
        return np.where(TASK.robot.terminal, np.log(max(end, 1e-4)), log_r[of] - np.log(shares[of]))

    return speak


def test_it_learns_where_a_model_goes():
    ahead = prepare(TASK)
    goal = len(ahead.bank.goals.distance) - 1
    _, _, given = drive(seeks(goal))
    belief = given[-1][0]
    row, column = np.argwhere(ahead.bank.goals.distance[goal] == 0)[0]
    off = ahead.bank.goals.distance[:, row, column] / 100.0  # metres from each goal to the true one
    *goals, wander = belief.probabilities()
    assert goals @ off < 0.25 * off.mean()
    assert wander < 0.1
    assert belief.trust > 0.9
    assert belief.style[0] == pytest.approx(2.8, rel=0.3)
    assert max(np.ptp(added) for _, added in given) > 1.0


def test_it_learns_that_a_model_goes_nowhere():
    _, _, given = drive(seeks(WANDER))
    belief = given[-1][0]
    assert belief.probabilities()[-1] > 0.9
    assert belief.trust > 0.9
    assert max(np.ptp(added) for _, added in given) > 1.0


@pytest.mark.parametrize("drift", [False, True])
def test_with_a_model_that_wants_nothing_it_vanishes(drift):
    """Likings and noise: habits predict such a model better than any goal does, and than wandering."""
    random, idle = np.random.default_rng(3), TASK.robot.motion_of == TASK.robot.motions.index((0.0, 0.0))
    wants = random.normal(0, 1.5, len(idle))

    def speak(t, pose, _):
        noise = random.normal(0, 0.3, len(idle))
        wants[:] = 0.95 * wants + noise if drift else wants
        return wants + (0.0 if drift else noise) - 2.0 * idle

    _, _, given = drive(speak, 40)
    assert all(belief.trust < 0.2 for belief, _ in given[30:])
    assert all(np.ptp(added) < 2.0 for _, added in given[20:])


def test_it_is_pure_and_its_memory_travels_as_bytes():
    ahead, history, given = drive(seeks(0), 12)
    belief, added = given[10]
    memory = belief.to_bytes()
    assert len(memory) < 8_000
    log_prior = log_softmax(seeks(0)(11, history[11], None))
    again = ahead.step(memory, history[:12], {}, log_prior, ALL)
    once, added_once = ahead.step(bytes(memory), history[:12], {}, log_prior, ALL)
    assert again[0] == once
    older = ahead.step(memory[:-8], history[:12], {}, log_prior, ALL)  # written by another version
    assert older[0] == ahead.step(ahead.begin(), history[:12], {}, log_prior, ALL)[0]
    np.testing.assert_array_equal(again[1], added_once)
    assert np.all(added[TASK.robot.terminal] == 0.0)
    assert np.all(added <= 0.0)


def test_it_learns_but_prefers_nothing_until_the_rule_has_cost_enough():
    ahead, history, given = drive(seeks(0), 12, forced=0.0)
    assert not any(added.any() for _, added in given)  # everything was feasible, so nothing was forced
    belief, log_prior = given[-1][0], log_softmax(seeks(0)(11, history[11], None))
    assert belief.trust > 0.5
    going_on = np.where(TASK.robot.terminal, 0.0, np.exp(log_prior))
    likeliest = int(np.argmax(going_on))
    for feasible in (~TASK.robot.terminal & (np.arange(len(going_on)) != likeliest), going_on == 0.0):
        after, added = advance(ahead, belief, history[:12], {}, log_prior, feasible)
        kept = going_on[feasible].sum() / going_on.sum()
        forced = -going_on.sum() * math.log(kept) if kept > 0.0 else FORCED
        assert after.forced == pytest.approx(forced)
        assert added.any() == (after.forced >= FORCED)
    assert added.any()  # without any feasible action the rule has cost enough


def test_a_model_that_only_ends_teaches_nothing():
    ahead = prepare(TASK)
    log_prior = np.where(TASK.robot.terminal, 0.0, -np.inf)
    memory, added = ahead.step(ahead.begin(), np.array([[-0.4, 2.4, 0.2]]), {}, log_prior, ALL)
    assert not added.any()
    assert memory == ahead.begin()


def test_goals_cover_the_floor_and_ways_lead_to_them():
    body = make_body(TASK.robot, TASK.grid)
    goals = make_goals(body, TASK.grid)
    assert 10 < len(goals.distance) < 60
    for g in range(len(goals.distance)):
        row, column = np.argwhere(goals.distance[g] == 0)[0]
        assert body.clearance[row, column] > body.radius
        away = np.argwhere((goals.distance[g] < 60000) & (goals.distance[g] > 100))
        row, column = away[len(away) // 2]
        v, u = row + 0.5, column + 0.5
        for _ in range(400):  # follow the way
            du, dv = goals.way[g, int(v), int(u)]
            v, u = v + 0.3 * dv / 127, u + 0.3 * du / 127
        assert goals.distance[g, int(v), int(u)] < 40
    assert end_chance(0) > 0.2
    assert end_chance(300) < 1e-6
