"""The planner against every future of a small world, a rule of each shape; robots, files."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from specshield.caution.surprise.barred import in_vain
from specshield.episode import Config, decide, make_shield, start
from specshield.errors import InfeasibleStart, PolicyError
from specshield.policy.methods import Run, load_policy
from specshield.policy.planner import first_motions
from specshield.policy.planner import policy as planner
from specshield.policy.planner.policy import Settings, synthesise
from specshield.robot import STRETCH, robot_from_json
from specshield.robot.dynamics import make_body, simulate
from specshield.shield.uncertainty import Uncertainty
from specshield.stl import robustness
from specshield.task import make_task
from specshield.world.occupancy import OccupancyGrid
from tests.oracles.brute_stl import brute_robustness
from tests.oracles.cells import END, MOTIONS, Cells
from tests.oracles.judge import signed_distance
from tests.policy.rooms import CUSTOM, OCCUPIED, REGIONS, flat
from tests.stl.formulas import formulas

RESTLESS = robot_from_json({"footprint": {"radius": 0.1}, "actions": [{"name": "go", "translate": 0.1}]})
EVENT = np.zeros(8)  # the signal, held from the newest sample on, as the oracles below read it


def within(inside, a, b):
    """F[a,b] at every step from 0 to T - b."""
    return np.stack([inside[..., k + a : k + b + 1].any(-1) for k in range(inside.shape[-1] - b)], axis=-1)


WORLDS = {
    "patrol": Cells(
        "G[0,3] F[0,4] A and G[0,3] F[0,4] B and G[0,7] not C",
        lambda s: within(s["A"], 0, 4).all(-1) & within(s["B"], 0, 4).all(-1) & ~s["C"].any(-1),
        {"A": (0, 0), "B": (0, 1), "C": (1, 0)},
    ),
    "reactive": Cells(
        "G[0,4] (event > 0.5 -> F[0,3] A)",
        lambda s: np.all([(EVENT[k] <= 0.5) | within(s["A"], 0, 3)[..., k] for k in range(5)], axis=0),
        {"A": (1, 2)},
        {"event": 0.0},
    ),
    "reactive, in one predicate": Cells(
        "G[0,4] F[0,3] (event < 0.5 or A) and F[3,7] B",
        lambda s: within((EVENT < 0.5) | s["A"], 0, 3).all(-1) & s["B"][..., 3:].any(-1),
        {"A": (1, 2), "B": (2, 2)},
        {"event": 0.0},
    ),
    "until": Cells(
        "not B U[0,6] A and F[4,7] B",
        lambda s: (
            np.any([s["A"][..., k] & ~s["B"][..., :k].any(-1) for k in range(7)], axis=0)
            & s["B"][..., 4:].any(-1)
        ),
        {"A": (2, 2), "B": (2, 1)},
    ),
    "disjunction": Cells(
        "F[0,5] A and F[3,7] C or G[2,7] B",
        lambda s: (s["A"][..., :6].any(-1) & s["C"][..., 3:].any(-1)) | s["B"][..., 2:].all(-1),
        {"A": (2, 1), "B": (0, 1), "C": (2, 2)},
    ),
    "nested": Cells(
        "G[0,4] (A -> F[0,3] B) and F[0,5] (A and F[1,2] not A)",
        lambda s: (
            np.all([~s["A"][..., k] | within(s["B"], 0, 3)[..., k] for k in range(5)], axis=0)
            & np.any([s["A"][..., k] & ~s["A"][..., k + 1 : k + 3].all(-1) for k in range(6)], axis=0)
        ),
        {"A": (2, 2), "B": (2, 1)},
    ),
    "a dwell, then away": Cells(
        "F[1,3] G[1,3] A and G[5,7] not A",
        lambda s: s["A"][..., 2:5].all(-1) & ~s["A"][..., 5:].any(-1),
        {"A": (2, 2)},
    ),
    "a dwell, then on": Cells(
        "G[0,4] (A or C) and F[0,7] B",
        lambda s: (s["A"] | s["C"])[..., :5].all(-1) & s["B"].any(-1),
        {"A": (2, 2), "B": (2, 1), "C": (1, 2)},
    ),
}
EACH = pytest.mark.parametrize("cells", WORLDS.values(), ids=list(WORLDS))
STARTS = [(i, j, h) for i, j in ((0, 0), (0, 1), (1, 2), (2, 1), (2, 2)) for h in range(4)]


def see(samples):
    """The signal so far, for a decision; the oracles see it held."""
    EVENT[: len(samples)], EVENT[len(samples) :] = samples, samples[-1]
    return {"event": np.array(samples)}


@EACH
def test_what_it_claims_is_so_and_it_claims_nearly_all(cells):
    """S_t of the planner alone, no witness carried, along random ways and with events at random steps."""
    shield, random = make_shield([synthesise(cells.task, Settings(pitch=0.2))]), np.random.default_rng(2)
    found = missed = 0
    for state in STARTS:
        history, rise = [cells.pose(*state)], random.integers(8)
        for t in range(cells.task.horizon):
            signals = see([float(k >= rise) for k in range(t + 1)])
            expected = cells.feasible(history)
            decision = decide(shield, history, np.zeros(5), signals=signals if cells.signals else {})
            if decision.mode in ("shaped", "fallback"):
                claimed = np.array(decision.j_values[:MOTIONS]) == 1.0
                assert not (claimed & ~expected).any()
                found, missed = found + claimed.sum(), missed + (expected & ~claimed).sum()
            likely = (
                np.flatnonzero(expected) if expected.any() and random.random() < 0.8 else np.arange(MOTIONS)
            )
            history.append(decision.next_poses[random.choice(likely)])
    assert found > 50
    assert missed <= 0.02 * found


@EACH
def test_once_feasible_always_feasible(cells):
    """Whatever the model wants; a signal stays as it was at the start, as J supposes."""
    shield, random = make_shield([synthesise(cells.task, Settings(pitch=0.2))]), np.random.default_rng(3)
    played = 0
    for state in STARTS:
        history, carry, done = [cells.pose(*state)], None, False
        event = float(random.integers(2)) if cells.signals else 0.0
        see([event])
        if not cells.feasible(history).any():
            if event == 0.0:  # as the signal is before its first sample
                with pytest.raises(InfeasibleStart):
                    start(shield, history[0])
            continue
        for t in range(cells.task.horizon):
            signals = see([event] * (t + 1)) if cells.signals else {}
            logits = random.normal(0, 3, 5)
            decision = decide(shield, history, None if done else logits, done, signals, carry)
            assert decision.reason != "infeasible"
            action = int(random.choice(5, p=decision.distribution))
            if action == END:
                done = True
                action = END if decision.completion_action is None else decision.completion_action
            history.append(decision.next_poses[action])
            carry = decision.carry
        signals = see([event] * 8) if cells.signals else {}
        assert cells.kept(history)
        assert robustness(cells.task.formula, cells.task.samples(np.array(history), signals)) > 0.0
        played += 1
    assert played >= 3


@settings(max_examples=60)
@given(formula=formulas(), robot=st.sampled_from([STRETCH, CUSTOM, RESTLESS]), data=st.data())
def test_any_formula_has_a_proposal_for_every_motion(formula, robot, data):
    """Whatever is asked for, whatever the robot: rows for the shield, and what it certifies is so."""
    assume(formula.horizon >= 1)
    regions = {"Charger1": REGIONS["West"], "Bedroom_2": REGIONS["East"]}
    signals = {"_": 1.0, "GF": 0.0, "notable": -1.0}
    task = make_task(OccupancyGrid(OCCUPIED, 0.1), robot, str(formula), regions, signals=signals)
    policy = synthesise(task, Settings(pitch=0.2))
    heading = data.draw(st.floats(-3.0, 3.0))
    history = np.array([[0.8, 1.5, heading], [0.9, 1.5, heading]])[: task.horizon]
    proposal = policy.propose(history, {}, 0.0)
    assert sorted(set(proposal.motions[:, 0])) == list(range(len(robot.motions)))
    shield = make_shield([policy])
    decision = decide(shield, history, np.zeros(len(robot.actions)), witnesses=True)
    for action, witness in enumerate(decision.witnesses):
        if witness is not None and decision.spec_status == "pending":
            ways = np.array([robot.motion_of[a] for a in (action, *witness)], np.int64)
            after = np.empty((len(ways), 3))
            simulate(shield.body, history[-1], ways, after)
            samples = {n: v.tolist() for n, v in task.samples(np.concatenate([history, after])).items()}
            assert brute_robustness(task.formula, samples) > 0.0


ROOM = OccupancyGrid(np.zeros((60, 60), bool), 0.1)


def rectangle(x0, y0, x1, y1):
    return {"type": "rectangle", "min": [x0, y0], "max": [x1, y1]}


def decide_at(policy, pose, **asked):
    robot = policy.task.robot
    decision = decide(make_shield([policy]), [pose], np.zeros(len(robot.actions)), **asked)
    return decision, np.array(decision.j_values, float)[robot.representative]


@pytest.mark.parametrize("half", [0.5, 0.25])
def test_an_until_goes_round_what_lies_between(half):
    """Who is never in K keeps the until: where that is to be had, so is this."""
    regions = {"K": rectangle(2.5 - half, 2.5 - half, 2.5 + half, 2.5 + half), "B": rectangle(4, 4, 5, 5)}
    until, never = (
        synthesise(make_task(ROOM, STRETCH, rule, regions))
        for rule in ("not K U[0,60] B", "F[0,60] B and G[0,60] not K")
    )
    for pose in ((1, 1, 0), (1.5, 1.5, 0), (1, 3, 0), (1.6, 2.5, 0), (0.5, 0.5, 2), (2.5, 1, 1.5)):
        stricter = decide_at(never, pose)[1]
        assert stricter.any()
        assert (decide_at(until, pose)[1] >= stricter).all()


@pytest.mark.parametrize("a", [0, 30])
def test_a_negated_until_says_which_place_comes_first(a):
    """To B only after A: a plan that waits by single steps until it may go there needs too many of them."""
    regions = {"A": rectangle(1, 1, 2, 2), "B": rectangle(4, 4, 5, 5)}
    rule = f"not (not A U[{a},200] B) and F[{a},200] B and G[{a},{a + 3}] not B"
    policy = synthesise(make_task(ROOM, STRETCH, rule, regions))
    assert policy.card["metrics"]["feasible_start"] == 1.0


def test_an_until_stays_in_a_corridor_up_to_where_it_leads():
    """The left side ends where the right one begins: no pose is in both, and no goal in the left."""
    regions = {"Up": rectangle(1, 1, 2, 4), "Along": rectangle(1, 3, 4, 4), "B": rectangle(4, 3, 5, 4)}
    policy = synthesise(make_task(ROOM, STRETCH, "(Up or Along) U[0,60] B", regions))
    decision, feasible = decide_at(policy, (1.5, 1.5, 0.0), witnesses=True)
    assert feasible.all()
    ways = np.array([STRETCH.motion_of[a] for a in (decision.action, *decision.witness)], np.int64)
    after = np.empty((len(ways), 3))
    simulate(make_shield([policy]).body, np.array([1.5, 1.5, 0.0]), ways, after)
    inside = {n: [signed_distance(region, x, y) > 0 for x, y, _ in after] for n, region in regions.items()}
    there = inside["B"].index(True)
    assert all(np.logical_or(inside["Up"], inside["Along"])[:there])


def test_who_waits_for_a_policy_is_told_how_far_it_is():
    told = []
    task = make_task(ROOM, STRETCH, "G[0,20] F[0,40] B", {"B": rectangle(4, 4, 5, 5)})
    run = Run(on_progress=lambda done, left, said: told.append((done, left)))
    synthesise(task, Settings(pitch=0.2), run)
    shares = [done for done, _ in told]
    assert len(set(shares)) > 20
    assert shares == sorted(shares)
    assert shares[0] > 0.0
    assert told[-1] == (1.0, 0.0)


def test_a_robot_that_cannot_stand_still_is_planned_for():
    """It turns where it would wait; a row for every motion."""
    task = flat("G[0,20] F[0,40] West and F[10,60] East", CUSTOM)
    policy = synthesise(task)
    history = np.array([[*task.grid.to_map((1.5, 1.5)), 0.3]])
    shield = make_shield([policy])
    proposal = policy.propose(history, {}, 0.0)
    assert proposal.motions[:, 0].tolist() == [0, 1, 2]
    assert any(decide(shield, history, np.zeros(3)).j_values)


FORWARD = {"name": "go", "translate": 0.2}
HASTY = {  # none of them has a turn on the spot and a stop
    "car": [FORWARD, *({"name": f"arc {a}", "translate": 0.15, "rotate": a} for a in (0.5, -0.5))],
    "no stop": [FORWARD, *({"name": f"turn {a}", "rotate": a} for a in (1.5, -1.5))],
    "rail": [FORWARD, {"name": "back", "translate": -0.2}, {"name": "stop"}],
}


@pytest.mark.parametrize("actions", HASTY.values(), ids=list(HASTY))
def test_a_robot_that_has_to_bide_its_time_in_motion_is_there_in_time(actions):
    """Windows that open later than it could be there, or leave, against every way of seven motions."""
    robot = robot_from_json({"footprint": {"radius": 0.1}, "actions": actions})
    random, found, missed = np.random.default_rng(4), 0, 0
    choices = np.array(list(itertools.product(range(3), repeat=7)))
    for rule in ("F[3,7] C", "G[5,7] not C", "F[7,7] C", "F[4,7] C and G[0,2] C"):
        task = make_task(ROOM, robot, rule, {"C": {"type": "circle", "center": [3, 3], "radius": 0.6}})
        policy, ways = synthesise(task), np.empty((len(choices), 8, 3))
        body = make_shield([policy]).body
        for _ in range(6):
            ways[:, 0] = *random.uniform(2.5, 3.5, 2), random.uniform(-3.1, 3.1)
            for motions, poses in zip(choices, ways, strict=True):
                simulate(body, poses[0], motions, poses[1:])
            kept = robustness(task.formula, task.samples(ways)) > 0.0
            some = np.array([kept[choices[:, 0] == m].any() for m in range(3)])
            claimed = decide_at(policy, ways[0, 0])[1] == 1.0
            assert not (claimed & ~some).any()
            found, missed = found + claimed.sum(), missed + (some & ~claimed).sum()
    assert found > 40
    assert missed <= 0.02 * found


def test_what_is_broken_is_dropped_and_the_rest_is_kept():
    """Begun on the forbidden cell: the rule is lost, its patrol and the rest of its G are not."""
    rule = "G[0,7] not C and F[3,7] B"
    cells = Cells(rule, lambda s: ~s["C"].any(-1) & s["B"][..., 3:].any(-1), {"B": (0, 0), "C": (0, 2)})
    shield = make_shield([synthesise(cells.task, Settings(pitch=0.2))])
    history, carry = [cells.pose(0, 2, 3)], None
    while len(history) <= cells.task.horizon:
        decision = decide(shield, history, None, True, carry=carry)
        assert decision.mode == "violated"
        history.append(decision.next_poses[decision.completion_action])
        carry = decision.carry
    states = [cells.state(pose)[:2] for pose in history]
    assert (0, 2) not in states[1:]
    assert (0, 0) in states[3:]


@pytest.mark.parametrize("rest", ["F[5,40] A", "F[5,40] A and G[0,40] not K"])
def test_a_rule_over_a_signal_that_stays_broken_leaves_the_rest_to_be_kept(rest):
    """What asks for the signal again cannot be had as long as it is held; what is left can."""
    regions = {"A": rectangle(4, 0.5, 5, 1.5), "K": rectangle(2, 0.5, 3, 1.5)}
    regions = {name: region for name, region in regions.items() if name in rest}
    task = make_task(ROOM, STRETCH, f"G[0,40] (bat > 0.2) and {rest}", regions, signals={"bat": 1.0})
    history, bat = np.array([[1.0, 1.0, 0.0]] * 2), np.array([1.0, 0.1])
    rows = synthesise(task).propose(history, {"bat": bat}, 0.0).motions
    body, poses = make_body(STRETCH, ROOM), np.empty((*rows.shape, 3))
    for motions, out in zip(rows, poses, strict=True):
        simulate(body, history[-1], motions, out)
    ways = np.concatenate([np.broadcast_to(history, (len(poses), 2, 3)), poses], axis=1)
    whole = make_task(ROOM, STRETCH, rest, regions)
    assert (robustness(whole.formula, whole.samples(ways)) > 0.0).all()


def test_a_policy_comes_back_from_its_files_as_it_was():
    task = WORLDS["patrol"].task
    policy = synthesise(task, Settings(pitch=0.2))
    again = load_policy(policy.weights(), policy.card, task)
    history = np.array([WORLDS["patrol"].pose(0, 0, 0)])
    ours, theirs = policy.propose(history, {}, 0.0), again.propose(history, {}, 0.0)
    np.testing.assert_array_equal(ours.motions, theirs.motions)
    assert synthesise(task, Settings(pitch=0.2)).weights() == policy.weights()
    with pytest.raises(PolicyError, match="do not fit"):
        load_policy(policy.weights(), {**policy.card, "options": {"pitch": 0.1}}, task)
    with pytest.raises(PolicyError, match="safetensors"):
        load_policy(policy.weights()[:-9], policy.card, task)


def test_where_there_is_nothing_to_find_it_ends_and_says_the_same_again():
    patrols = " and ".join(f"G[0,80] F[0,20] {name}" for name in ("West", "East", "Hole"))
    policy = synthesise(flat(f"{patrols} and (F[0,99] West or G[0,50] East or not West U[3,90] Hole)"))
    history = np.array([[*policy.task.grid.to_map((1.0, 1.0)), 0.0]])
    first, second = (policy.propose(history, {}, 0.0) for _ in range(2))
    np.testing.assert_array_equal(first.motions, second.motions)


@pytest.mark.parametrize("x", [1.5, 1.87])
def test_a_way_is_found_without_the_motions_that_led_nowhere(x):
    """Nothing leads straight ahead, nor backwards. The second place is too near a wall for the lattice to
    know a way out, which takes two motions.
    """
    task = flat("F[0,60] West")
    policy, body = synthesise(task), make_body(task.robot, task.grid)
    history = np.array([[*task.grid.to_map([x, 0.5]), task.grid.origin[2] + np.pi]])
    history[0, 2] -= 2.0 * np.pi
    moves = [m for m, (far, _) in enumerate(task.robot.motions) if far]
    barred = np.array([[*history[0], m, 0.01, 0.2] for m in moves])
    ways = policy.avoiding(barred).propose(history, {}, 0.0).motions
    poses = np.empty((*ways.shape, 3))
    for motions, led in zip(ways, poses, strict=True):
        simulate(body, history[0], motions, led)
    free = ~in_vain(barred, history[0], ways, poses, True)
    driven = [task.samples(np.concatenate([history, led])) for led in poses[free]]
    assert any(robustness(task.formula, each) > 0.0 for each in driven)


def test_a_robot_of_many_motions_does_not_plan_after_each_of_them_in_vain(monkeypatch):
    """A wall has no way through: each search costs what it may, and there are as many as the budget has: from
    x_t, after staying, and 8 of 60 others. They were 4 others, too few to find what there is (below).
    """
    occupied = np.zeros((40, 40), np.bool_)
    occupied[:, 20] = True
    turns = [{"name": f"turn{k}", "rotate": 0.05 * k} for k in range(1, 60)]
    actions = [{"name": "wait"}, {"name": "go", "translate": 0.1}, *turns]
    robot = robot_from_json({"footprint": {"radius": 0.1}, "actions": actions})
    place = {"A": {"type": "circle", "center": [1.5, 1.0], "radius": 0.2}}
    task = make_task(OccupancyGrid(occupied, 0.05), robot, "F[0,60] A or F[0,60] A", place)
    policy, searches = synthesise(task), []

    def search(world, way, nodes, n, effort):
        searches.append(n)
        way.spent[0] += effort
        return False

    monkeypatch.setattr(first_motions, "search", search)
    monkeypatch.setattr(first_motions, "search_exactly", lambda *_: False)
    monkeypatch.setattr(planner, "plan_all", first_motions.plan_all.py_func)
    policy.propose(np.array([[0.5, 1.0, 0.0]]), {}, 0.0)
    assert 3 <= len(searches) <= 10


def test_of_many_first_motions_that_few_ways_begin_with_one_is_found():
    """No plan is found from the pose itself, and after the first turns of the list there is no way. Once, the
    bound on what is searched in vain came before a turn after which there is one, and nothing was allowed.
    """
    occupied = np.zeros((60, 60), np.bool_)
    occupied[:, 30] = True
    occupied[20:30, 30] = False
    turns = [0.1 * k for k in range(1, 34)] + [-0.1 * k for k in range(1, 30)]
    actions = [{"name": "wait"}, {"name": "go", "translate": 0.1}]
    actions += [{"name": f"turn{n}", "rotate": turn} for n, turn in enumerate(turns)]
    robot = robot_from_json({"footprint": {"radius": 0.1}, "actions": actions})
    places = {"A": [2.3, 2.0], "B": [0.7, 1.6]}
    regions = {name: {"type": "circle", "center": at, "radius": 0.15} for name, at in places.items()}
    rule = "F[0,18] (B and F[0,18] A) or G[0,18] x < 0"
    task = make_task(OccupancyGrid(occupied, 0.05), robot, rule, regions)
    shield = make_shield([synthesise(task)])
    decision = decide(shield, np.array([[0.5, 1.0, 0.7]]), np.zeros(len(actions)))
    assert decision.mode == "shaped"
    assert sum(value > 0 for value in decision.j_values) >= 40


FORWARD_ONLY = robot_from_json(
    {
        "footprint": {"radius": 0.1},
        "on_contact": "stop",
        "actions": [
            {"name": "go", "translate": 0.2},
            {"name": "left", "rotate": math.pi / 6},
            {"name": "right", "rotate": -math.pi / 6},
            {"name": "wait"},
        ],
    }
)
ISLE = {
    "A": {"type": "rectangle", "min": [1.2, 0.9], "max": [2.2, 2.1]},
    "B": {"type": "rectangle", "min": [3.5, 0.0], "max": [4.0, 3.0]},
}


@pytest.mark.parametrize("said", ["A -> F[0,18] B", "not A or F[0,18] B"])
@pytest.mark.parametrize("doubts", [None, Uncertainty(0.0, 0.0, 0.05)])
def test_a_response_begins_where_its_answer_is_nearest(said, doubts):
    """The robot looks at A from the east. If it drives straight in, to x = 2.05, it turns round by 6 turns
    and drives 8 times 0.2 m, beyond x = 3.5: 14 steps. If it turns round first and drives through a corner of
    A, 8 or 9 steps are enough. A session that is told of slips does so, since it asks for 9 of the 18 steps.
    """
    grid = OccupancyGrid(np.zeros((60, 80), bool), 0.05, (0.0, 0.0, 0.0))
    task = make_task(grid, FORWARD_ONLY, f"F[0,60] A and G[0,60] ({said})", ISLE)
    policy = synthesise(task)
    pose = np.array([2.65, 1.5, math.pi])

    def took(motions):
        """From the first step in A to the first in B."""
        led = np.empty((len(motions), 3))
        simulate(make_body(FORWARD_ONLY, grid), pose, np.array(motions), led)
        there = (np.abs(led[:, 0] - 1.7) < 0.5) & (np.abs(led[:, 1] - 1.5) < 0.6)
        assert there.any()
        assert led[-1, 0] > 3.5
        return int(np.argmax(led[:, 0] > 3.5) - np.argmax(there))

    ways = policy.propose(pose[None], {}, 0.0)
    assert took(ways.motions[ways.preferred]) == 14
    found = decide(make_shield([policy], Config(uncertainty=doubts)), pose[None], np.zeros(4))
    went = took([found.action, *found.witness])
    assert went in ((8, 9) if doubts else (14,))
    again = load_policy(policy.weights(), policy.card, task)
    ways = again.promptly().propose(pose[None], {}, 0.0)
    assert took(ways.motions[ways.preferred]) in (8, 9)


def test_a_rule_without_responses_is_planned_for_as_before():
    policy = synthesise(WORLDS["patrol"].task, Settings(pitch=0.2))
    assert policy.promptly() is policy
    assert policy.chosen.shape[1] == 2
