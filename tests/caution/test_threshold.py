"""A threshold over the episode: V beside a model checker's best policy, and asked against kept."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from specshield.caution.experience import learn
from specshield.caution.judgement import Situation, judge
from specshield.caution.noise import Noise
from specshield.caution.threshold import MOST_SLIPS, _in_time, chances
from specshield.episode import Config, close, decide, make_shield
from specshield.local import LocalShield
from specshield.policy.planner import policy as planner
from specshield.robot import STRETCH, robot_from_json
from specshield.shield.feasibility import prefix_of
from specshield.shield.proposal import Proposal
from specshield.shield.uncertainty import Uncertainty
from specshield.task import make_task
from specshield.world.occupancy import OccupancyGrid
from tests.made import synthesise
from tests.oracles.cells import FORWARD, WAIT, Cells, ways

VECTORS = json.loads((Path(__file__).parents[1] / "oracles/storm/vectors.json").read_text())
RULE, REGIONS = "F[0,4] A and F[5,12] B", {"A": (2, 0), "B": (0, 0)}


class Everything:
    """Proposes every future there is to a near horizon, waiting after that."""

    id = "everything"

    def __init__(self, cells):
        self.task = cells.task

    def propose(self, history, signals, margin):
        steps = self.task.horizon + 1 - len(history)
        rows = ways(min(steps, 6))
        return Proposal(np.pad(rows, ((0, 0), (0, steps - rows.shape[1])), constant_values=WAIT), WAIT)


def tables(cells):
    return synthesise(cells.task)


def plan(cells):
    return planner.synthesise(cells.task)


def v_of(shield, care, prefix, judged):
    """V of each action, while nothing is certified yet."""
    count = len(shield.task.robot.motions)
    return chances(shield, care, prefix, judged, np.zeros(count, bool), (None,) * count)[0]


def v_at_first(proposer, pose, slip):
    """V of each action at the first step, if each motion is known to slip with this probability."""
    task, poses, config = proposer.task, np.array([pose]), Config(uncertainty=Uncertainty(0.0, 0.0, slip))
    shield = make_shield([proposer], replace(config, threshold_over="episode"))
    prefix = prefix_of(task, task.formula, shield.view, poses, {})
    _, care = learn(shield, None, poses)
    known = care.noise._replace(lost=max(1e9 * slip, 1e-9), kept=1e9 * (1.0 - slip))
    care = care._replace(noise=known)
    return v_of(shield, care, prefix, judge(shield, Situation(prefix, None, "pending", care)))


@pytest.mark.parametrize("formula", sorted({vector["formula"] for vector in VECTORS}))
@pytest.mark.parametrize("make", [Everything, tables, plan])
def test_v_is_never_above_what_the_best_policy_has(formula, make):
    found = []
    for vector in (v for v in VECTORS if v["formula"] == formula):
        cells = Cells(formula, None, {name: tuple(cell) for name, cell in vector["cells"].items()})
        values = v_at_first(make(cells), cells.pose(*vector["start"]), vector["slip"])
        found.append((values[:4], vector["best"], vector["slip"]))
    for values, best, slip in found:
        assert np.all(values <= np.array(best) + 1e-9), (values, best, slip)
    if make is tables:
        assert all(values == pytest.approx(best) for values, best, slip in found if slip == 0.0)
    if make is plan:  # where the lattice of a table sees no way through a corridor of the robot's width
        assert all(max(values) > max(best) - 0.011 for values, best, _ in found)  # V is rounded down


@pytest.mark.parametrize("slip", [0.0, 0.1])
@pytest.mark.parametrize("asked", [0.5, 0.9])
def test_the_rule_is_kept_as_often_as_was_asked(asked, slip):
    cells = Cells(RULE, None, REGIONS)
    config = Config(threshold=asked, threshold_over="episode", uncertainty=Uncertainty(0.0, 0.0, slip))
    shield, kept, runs = make_shield([synthesise(cells.task)], config), 0, 200
    for run in range(runs):
        random, history, carry = np.random.default_rng(run), [cells.pose(0, 0, 0)], None
        shield = make_shield(shield.proposers, Config(**{**vars(config), "seed": run}))
        for _ in range(cells.task.horizon):
            logits = np.append(random.normal(0.0, 2.0, 3), [0.0, -np.inf])
            found = decide(shield, history, logits, carry=carry)
            assert 0.0 <= found.threshold_left <= 1.0
            if found.spec_status != "pending":  # whatever comes
                break
            carry, state = found.carry, cells.state(history[-1])
            state = state if random.random() < slip else cells.after(state, found.action)
            history.append(cells.pose(*state))
        kept += close(shield, history)[0] == "satisfied"
    spread = 1.8 * np.sqrt(asked * (1.0 - asked) / runs)
    assert kept / runs >= asked - spread
    assert kept / runs <= asked + spread + 0.05


class Once(Everything):
    """Proposes every future at the first step, and only waits at later ones."""

    def propose(self, history, signals, margin):
        if len(history) == 1:
            return super().propose(history, signals, margin)
        return Proposal(np.full((1, self.task.horizon + 1 - len(history)), WAIT), WAIT)


@pytest.mark.parametrize("asked", [0.3, 0.95])
def test_a_way_that_gave_an_action_its_chance_is_there_at_the_next_step(asked):
    """Each draw and each slip is followed to the end, so that nothing but the rounding of V is left to
    chance. Without slack a way is not certified, but it may have a chance.
    """
    cells, slip = Cells("F[0,4] A", None, {"A": (1, 0)}), 0.1
    config = Config(uncertainty=Uncertainty(0.0, 0.0, slip), threshold=asked, threshold_over="episode")
    shield = make_shield([Once(cells)], config)

    def kept(history, carry):
        states = [cells.state(pose) for pose in history]
        if (1, 0) in [state[:2] for state in states]:
            return 1.0
        if len(history) > cells.task.horizon:
            return 0.0
        found, chance = decide(shield, history, [0.0, 0.0, 0.0, 3.0, -np.inf], carry=carry), 0.0
        for action in np.flatnonzero(found.distribution):
            there = cells.after(states[-1], action)
            ends = {there: 1.0 - slip, states[-1]: slip} if there != states[-1] else {there: 1.0}
            after = found.carry._replace(action=int(action))
            chance += found.distribution[action] * sum(
                share * kept([*history, cells.pose(*state)], after) for state, share in ends.items()
            )
        return chance

    assert asked <= kept([cells.pose(0, 0, 0)], None) <= asked + 0.05


X = Cells(RULE, None, REGIONS).pose(0, 0, 0)[0]
SINGULAR = f"(x > 0.4 and 1 / (x - {X}) > -99)"  # 1 / 0 at step 0, else that the robot is two cells ahead


@pytest.mark.parametrize(
    ("formula", "forward", "wait"),
    [
        ("F[0,2] x > -9 and G[2,2] x > 0.4", 0.64, 0.0),
        (f"F[0,2] x > -9 and G[2,2] {SINGULAR}", 0.64, 0.0),
        (f"G[2,3] {SINGULAR}", 0.64, 0.0),
        (f"G[3,3] {SINGULAR}", 0.896, 0.64),  # one of three may be lost
        ("F[1,1] G[2,2] A", 0.896, 0.64),
    ],
)
def test_v_is_never_above_what_was_computed_by_hand(formula, forward, wait):
    """A is two cells ahead of a robot whose motions are lost with a probability of 0.2."""
    cells = Cells(formula, None, {"A": (2, 0)})
    known = Uncertainty(0.0, 0.0, 0.2)
    shield = make_shield([Everything(cells)], Config(uncertainty=known, threshold_over="episode"))
    poses = np.array([cells.pose(0, 0, 0)])
    prefix = prefix_of(cells.task, cells.task.formula, shield.view, poses, {})
    _, care = learn(shield, None, poses)
    care = care._replace(noise=care.noise._replace(lost=2e8, kept=8e8))
    judged = judge(shield, Situation(prefix, None, "pending", care))
    values = v_of(shield, care, prefix, judged)
    assert values[0] <= forward + 1e-6
    assert values[WAIT] <= wait + 1e-6
    assert values[:4].max() >= 0.5  # and it is no bound that says nothing


def test_a_g_whose_arithmetic_is_not_finite_before_it_begins_is_decided():
    cells = Cells(f"F[0,8] A and G[9,10] {SINGULAR}", None, {"A": (2, 0)})
    config = Config(threshold=0.5, threshold_over="episode", uncertainty=Uncertainty(0.0, 0.0, 0.1))
    shield = make_shield([Everything(cells)], config)
    found = decide(shield, [cells.pose(0, 0, 0)], np.zeros(len(shield.task.robot.actions)))
    assert found.mode == "shaped"
    assert found.feasible_mass > 0.0


@pytest.mark.parametrize(
    ("blocks", "moves", "waits", "free", "lost", "kept", "each"),
    [
        (1, 5, 5, 0, 3.0, 57.0, True),
        (4, 8, 2, 0, 3.0, 57.0, True),
        (10, 5, 1, 3, 0.5, 4.5, False),
        (20, 8, 1, 5, 3.0, 57.0, True),
        (3, 6, 0, 2, 50.0, 950.0, True),
    ],
)
def test_being_in_time_is_as_likely_as_in_simulation(blocks, moves, waits, free, lost, kept, each):
    """Blocks of moves and then waits. At the end of each, or of the last alone, the robot is `free` steps
    late at most. The rate of slips is drawn from Beta(lost, kept), once a run.
    """
    motions, size = np.array(([0] * moves + [WAIT] * waits) * blocks), moves + waits
    due = [size * (i + 1) for i in range(blocks) if each or i == blocks - 1]
    random, runs, kept_runs = np.random.default_rng(0), 4000, 0
    for rate in random.beta(lost, kept, runs):
        late, in_time = 0, True
        for n, motion in enumerate(motions, 1):
            late = max(late - 1, 0) if motion == WAIT else late + random.geometric(1.0 - rate) - 1
            in_time = in_time and not (n in due and late > free)
        kept_runs += in_time
    noise, scratch = Noise(0.0, 0.0, 1.0, lost, kept), np.empty((MOST_SLIPS + 1, MOST_SLIPS + 2))
    deadlines = np.array([(n, free, len(motions)) for n in due])
    found = _in_time(noise, 0.0, True, deadlines, motions, WAIT, 0, scratch)
    share = kept_runs / runs
    assert abs(found - share) <= 3.0 * np.sqrt(max(share * (1.0 - share), 1.0 / runs) / runs) + 0.002


@pytest.mark.parametrize(
    ("spare", "expected"), [(0, 0.691462 * math.exp(-0.2)), (1, 0.933193 * math.exp(-0.2 * math.exp(-0.2)))]
)
def test_noise_makes_late_by_a_normal_deviate_and_now_and_then_by_more(spare, expected):
    """25 motions at 0.2 steps each: sigma is 1, and 0.04 x 0.2 x 25 times the robot is held up, for 5 steps
    in the mean. It is late by whole steps: by none where the deviate is below 0.5, by one where it is below
    1.5.
    """
    late, due = np.empty((MOST_SLIPS + 1, MOST_SLIPS + 2)), np.array([[25, spare, 25]])
    found = _in_time(Noise(0.01, 0.01, 0.0, 0.0, 1.0), 0.2, False, due, np.zeros(25, np.int64), -1, 0, late)
    assert found == pytest.approx(expected, abs=1e-6)


class Ahead:
    """Proposes to go three cells ahead and wait there."""

    id = "ahead"

    def __init__(self, task):
        self.task = task

    def propose(self, history, signals, margin):
        motions = np.full((1, self.task.horizon + 1 - len(history)), self.task.robot.wait_motion)
        motions[0, :3] = FORWARD
        return Proposal(motions, self.task.robot.wait_motion)


@pytest.mark.parametrize(("turns", "steers"), [((90,), False), ((), False), ((90, 30), True)])
@pytest.mark.parametrize("room", [0.01, 0.02])
def test_a_robot_that_cannot_steer_meets_the_walls_of_a_corridor_as_often_as_noise_leads_so_far(
    room, turns, steers
):
    """The robot has `room` on both sides. Its place is three moves ahead and due in 12 steps."""
    turned = [
        {"name": f"{way}{turn}", "rotate": way * math.radians(turn)} for turn in turns for way in (1, -1)
    ]
    actions = [{"name": "forward", "translate": 0.2}, {"name": "wait"}, *turned]
    robot = robot_from_json({"footprint": {"radius": 0.1 - room}, "actions": actions})
    task = make_task(OccupancyGrid(np.zeros((1, 8), bool), 0.2), robot, "F[0,12] x > 0.8", {})
    shield = make_shield(
        [Ahead(task)],
        Config(uncertainty=Uncertainty(0.005, math.radians(0.5), 0.0), threshold_over="episode"),
    )
    poses = np.array([[0.3, 0.1, 0.0]])
    prefix = prefix_of(task, task.formula, shield.view, poses, {})
    _, care = learn(shield, None, poses)
    judged = judge(shield, Situation(prefix, None, "pending", care))
    values = v_of(shield, care, prefix, judged)
    off = math.hypot(0.005, 0.2 * math.radians(0.5))  # after one motion; the root of n times as much after n
    met = sum(0.5 * math.erfc(room / (off * math.sqrt(2.0 * n))) for n in (1, 2, 3))
    spread = 2.0 * math.hypot(0.005 / 0.2, math.radians(0.5) / 0.1)
    late = 0.04 * spread * 12.0 * math.exp(-9.0 / 5.0)  # 9 steps are left beside the three
    expected = math.exp(-late - (0.0 if steers else 0.5 * met))
    assert expected - 0.01 <= values[0] <= expected


def test_an_earlier_way_is_found_where_all_ways_at_hand_are_just_in_time():
    """Forward, right, forward meets B by 2 mm in three steps, with a fourth to spare: a probability of 0.65.
    Deeper in B the same takes all four, as does waiting first.
    """
    turns = [{"name": "left", "rotate": math.pi / 4}, {"name": "right", "rotate": -math.pi / 4}]
    actions = [{"name": "forward", "translate": 0.25}, *turns, {"name": "wait"}]
    robot = robot_from_json({"footprint": {"radius": 0.15}, "actions": actions})
    place = {"B": {"type": "circle", "center": [0.6719783804, 1.6322866697], "radius": 0.25}}
    task = make_task(OccupancyGrid(np.zeros((24, 24), bool), 0.1), robot, "F[0,4] B", place)
    config = Config(uncertainty=Uncertainty(0.0, 0.0, 0.3), threshold=0.8, threshold_over="episode")
    shield = make_shield([synthesise(task)], config)
    found = decide(shield, [(1.3735920554, 1.5230849802, -2.8873782581)], [0.0, 0.0, 0.0, 3.0])
    assert found.distribution.tolist() == [1.0, 0.0, 0.0, 0.0]


@pytest.mark.parametrize(
    ("make", "pose"), [(synthesise, (2.792, 0.515, -0.778)), (planner.synthesise, (2.064, 0.463, 0.776))]
)
def test_a_part_that_is_due_later_is_met_earlier_than_just_in_time(make, pose):
    """B and then A are at least 27 motions away, and A is due at step 28. If each motion slips with a
    probability of 0.05, a way of 28 motions is in time with 0.238, and one of 27 with 0.588.
    """
    walls = np.zeros((40, 40), bool)
    walls[20, :24] = True
    places = {
        "A": {"type": "rectangle", "min": [0.3, 0.3], "max": [1.3, 1.3]},
        "B": {"type": "circle", "center": [3.0, 3.0], "radius": 0.5},
    }
    task = make_task(OccupancyGrid(walls, 0.1), STRETCH, "F[0,15] B and G[28,34] A", places)
    assert v_at_first(make(task), pose, 0.05).max() == 0.58


@pytest.mark.parametrize("over", ["step", "episode"])
def test_asking_for_all_over_the_episode_keeps_as_much_in_hand_as_asking_at_each_step(over):
    """The robot is off its way at each step, and its model has no goal. V alone lets time go by: it is as
    good as 1 until there is hardly any left.
    """
    pose, random = (4.5, 5.0, 0.0), np.random.default_rng(0)
    session = LocalShield.shipped("case1").session(initial_pose=pose, seed=1, threshold_over=over)
    for _ in range(36):
        decision = session.step(pose, [None if name == "end" else 0.0 for name in session.info.actions])
        assert decision.slack >= 19
        there = decision.next_poses[decision.execute]
        noise = random.normal(size=3) * (0.01, 0.01, 0.0087) if there != pose else np.zeros(3)
        pose = tuple((np.array(there) + noise).tolist())
