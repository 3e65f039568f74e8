"""What an explanation says is true: checked against every future of a robot on whole cells."""

import math
import re

import numpy as np
import pytest

from specshield.episode import decide, make_shield
from specshield.policy.planner import policy as planner
from specshield.reasons.explanation import explanations
from specshield.robot import robot_from_json
from specshield.shield.decision import Config
from specshield.shield.proposal import Proposal
from specshield.shield.uncertainty import Uncertainty
from specshield.task import make_task
from specshield.world.occupancy import OccupancyGrid
from tests.oracles.cells import FORWARD, MOTIONS, ROBOT, WAIT, Cells, Exhaustive, Scripted
from tests.reasons.rules_on_cells import dwells, until, visits

PLACES = {"A": (2, 0), "B": (0, 2), "C": (2, 2)}
EVEN = np.zeros(5)


def after(parts, history):
    """Whether some future keeps the rule after each motion; beyond its horizon no step counts."""
    cells, _ = visits(parts, PLACES)
    return cells.feasible(history)


def explained(parts, history, slack=0):
    cells, told = visits(parts, PLACES)
    shield = make_shield([Exhaustive(cells)], Config(slack=slack))
    return decide(shield, history, EVEN, explain=explanations), told


def test_what_is_late_would_be_kept_with_a_window_that_ends_so_much_later_and_with_none_that_ends_sooner():
    random, seen = np.random.default_rng(5), {"late": 0, "broken": 0, "several": 0}
    for _ in range(120):
        a, b = (int(v) for v in random.integers(2, 6, 2))
        parts = [("F", 0, a, "A"), ("F", 1, b, "B"), ("G", 0, 5, "C")][: random.integers(1, 4)]
        cells, _ = visits(parts, PLACES)
        history = [cells.pose(*random.integers(0, 2, 2).tolist(), int(random.integers(4)))]
        for _ in range(int(random.integers(0, 3))):
            history.append(cells.pose(*cells.after(cells.state(history[-1]), int(random.integers(3)))))
        decision, told = explained(parts, history)
        if decision.spec_status != "pending":
            continue
        exact = after(parts, history)
        for motion in range(MOTIONS):
            why = decision.explanations[motion]
            assert (why is None) == exact[motion]
            if why is None:
                continue
            i = told.index(why.conjunct)
            others = parts[:i] + parts[i + 1 :]
            op, start, end, place = parts[i]
            if why.late_by is None:
                alone = others and after(others, history)[motion]
                seen["broken" if op == "G" else "several"] += 1
                assert why.robustness <= 0.0 or not alone
                continue
            seen["late"] += 1
            assert op == "F"
            enough = [(op, start, end + why.late_by, place)]
            assert after(others + enough, history)[motion]
            assert not after([*others, (op, start, end + why.late_by - 1, place)], history)[motion]
    assert seen["late"] > 20, seen


def test_how_late_a_way_comes_is_counted_from_the_rules_own_window_also_with_slack():
    late = kept = 0
    cells, _ = visits([("F", 0, 5, "A")], PLACES)
    for i, j, heading in np.ndindex(3, 3, 4):
        for end in (2, 3, 4):
            history = [cells.pose(i, j, heading)]
            decision, _ = explained([("F", 0, end, "A")], history, slack=1)
            if decision.spec_status != "pending":
                continue
            exact = after([("F", 0, end, "A")], history)
            for motion, why in enumerate(decision.explanations[:MOTIONS]):
                if why is None or why.late_by is None:
                    continue
                assert (why.robustness > 0.0) == exact[motion]
                if exact[motion]:  # it is the slack that is missing
                    kept += 1
                    continue
                late += 1
                assert after([("F", 0, end + why.late_by, "A")], history)[motion]
                assert not after([("F", 0, end + why.late_by - 1, "A")], history)[motion]
    assert late > 10, (late, kept)


def test_an_action_that_breaks_a_keep_out_is_told_so():
    cells, told = visits([("G", 0, 3, "C")], PLACES)
    beside = cells.pose(1, 2, 0)  # C lies ahead
    assert cells.after((1, 2, 0), 0) == (2, 2, 0)  # no wall is in the way
    decision, _ = explained([("G", 0, 3, "C")], [beside])
    assert decision.explanations[0].conjunct == told[0]
    assert decision.explanations[0].late_by is None
    assert math.isclose(
        decision.explanations[0].robustness, -0.1, abs_tol=1e-9
    )  # the middle of a cell of 0.2 m
    assert decision.explanations[1:] == (None,) * 4


def test_without_being_asked_nothing_is_explained_and_the_decision_is_the_same():
    cells, _ = visits([("F", 0, 3, "A")], PLACES)
    shield, history = make_shield([Exhaustive(cells)]), [cells.pose(0, 0, 0)]
    plain = decide(shield, history, EVEN)
    asked = decide(make_shield([Exhaustive(cells)]), history, EVEN, explain=explanations)
    assert plain.explanations == ()
    assert np.array_equal(plain.distribution, asked.distribution)
    assert plain.j_values == asked.j_values


def test_when_the_rule_is_over_every_action_is_allowed():
    cells, _ = visits([("F", 0, 1, "A")], PLACES)
    decision = decide(make_shield([Exhaustive(cells)]), [cells.pose(2, 0, 0)] * 3, EVEN, explain=explanations)
    assert decision.explanations == (None,) * 5


def test_of_an_until_it_is_said_which_half_fails_and_when():
    seen = {"late": 0, "broken": 0, "late and broken": 0, "not met": 0}
    for i, j, heading in np.ndindex(4, 3, 4):
        for end in (2, 4):
            cells = until(end)
            history = [cells.pose(i, j, heading)]
            decision = decide(make_shield([Exhaustive(cells)]), history, EVEN, explain=explanations)
            if decision.spec_status != "pending" or (i, j) in ((1, 1), (1, 0)):
                continue
            exact = cells.feasible(history)
            for motion, why in enumerate(decision.explanations[:MOTIONS]):
                assert (why is None) == exact[motion]
                if why is None:
                    continue
                met, broken = (re.search(rf"'{side}' is {what} at step (\d+)", why.detail)
                               for side, what in (("A", "met"), ("not B", "broken")))  # fmt: skip
                if why.late_by is not None:
                    seen["late"] += 1
                    assert broken is None
                    assert int(met[1]) == end + why.late_by
                    assert until(end + why.late_by).feasible(history)[motion]
                elif met is not None:
                    seen["broken" if int(met[1]) <= end else "late and broken"] += 1
                    assert int(broken[1]) < int(met[1])
                else:
                    seen["not met"] += 1
                    assert "'A' is not met" in why.detail
    assert seen["late"] > 10, seen


def test_of_a_place_to_be_in_from_some_step_on_it_is_said_when_it_is_reached():
    seen = 0
    for i, j, heading in np.ndindex(4, 3, 4):
        for begin in (2, 3):
            cells = dwells(begin)
            history = [cells.pose(i, j, heading)]
            decision = decide(make_shield([Exhaustive(cells)]), history, EVEN, explain=explanations)
            exact = cells.feasible(history)
            for motion, why in enumerate(decision.explanations[:MOTIONS]):
                assert (why is None) == exact[motion] or (i, j) == (1, 1)
                if why is None or why.late_by is None:
                    continue
                seen += 1
                first = begin + why.late_by
                assert f"'A' holds only from step {first}, {why.late_by} step" in why.detail
                assert dwells(first).feasible(history)[motion]
                assert not dwells(first - 1).feasible(history)[motion]
    assert seen > 10


@pytest.mark.parametrize("motion", [0, 1, 2])
def test_a_way_that_the_policies_missed_is_not_denied(motion):
    cells, _ = visits([("F", 0, 5, "A")], PLACES)
    shield = make_shield([Scripted(cells, lambda t, first: [0, 0] if first == WAIT else [WAIT] * 9)])
    decision = decide(shield, [cells.pose(0, 0, 0)], EVEN, explain=explanations)
    why = decision.explanations[motion]
    assert cells.feasible([cells.pose(0, 0, 0)])[motion]
    assert decision.j_values[motion] == 0.0
    assert why.robustness > 0.0
    assert why.detail == "a way is known that keeps the rule, but the policies did not find it"


def test_where_slack_is_lacking_the_conjunct_is_named_that_lacks_it_however_deep_its_window_is():
    def keeps(inside):
        early, late = inside["A"][..., :3].any(axis=-1), inside["C"].any(axis=-1)
        answered = [~inside["A"][..., t] | inside["B"][..., t : t + 5].any(axis=-1) for t in range(3)]
        return early & np.all(answered, axis=0) & ~late

    visit, answer, lacking = "F[0,2] A", "G[0,2] (A -> F[0,4] B)", {}
    places = {"A": (2, 0), "B": (2, 2), "C": (3, 0)}
    cells = Cells(f"G[0,6] not C and {visit} and {answer}", keeps, places)
    for state in np.ndindex(3, 2, 4):
        poses = [cells.pose(*state)]
        shield = make_shield([Exhaustive(cells)], Config(slack=1))
        decision, (motions, kept) = decide(shield, poses, EVEN, explain=explanations), cells.futures(poses)
        for motion, why in enumerate(decision.explanations[:MOTIONS]):
            if why is not None and kept[motions[:, 0] == motion].any():
                lacking[why.conjunct] = lacking.get(why.conjunct, 0) + 1
                assert why.robustness > 0.0
    assert set(lacking) == {visit, answer}, lacking


@pytest.mark.parametrize(
    ("rule", "place", "motions"),
    [
        ("F[4,4] A", (2, 0), []),
        ("F[4,5] A", (2, 0), []),
        ("F[0,1] (A and F[1,7] A)", (0, 0), [FORWARD, WAIT]),
        ("G[5,5] (x > 0 -> G[0,1] A)", (2, 0), []),
    ],
)
def test_a_slack_that_is_longer_than_the_window_is_explained_all_the_same(rule, place, motions):
    cells = Cells(rule, lambda inside: inside["A"][..., 2:].any(axis=-1), {"A": place})
    poses = [cells.pose(0, 0, 0)]
    for motion in motions:
        poses.append(cells.pose(*cells.after(cells.state(poses[-1]), motion)))
    decision = decide(make_shield([Exhaustive(cells)], Config(slack=2)), poses, EVEN, explain=explanations)
    lacking = [why for why in decision.explanations if why is not None and why.robustness > 0.0]
    assert lacking
    assert all(why.late_by is None and why.detail is not None for why in lacking)


@pytest.mark.parametrize("slack", [0, 1])
def test_what_lacks_the_margin_is_named_and_not_what_was_near_an_edge_before(slack):
    """The first step is 5 cm from where G ends; what is to come keeps the margin there, and F does not."""
    cells = Cells("G[0,3] x > 0.05 and F[0,3] x > 0.4", None, {})
    history = [cells.pose(0, 0, 0), cells.pose(1, 0, 0)]
    proposer = Scripted(cells, lambda t, first: [0, WAIT] if first == 0 else [0])
    shield = make_shield([proposer], Config(margin=0.2, slack=slack))
    decision = decide(shield, history, EVEN, explain=explanations)
    assert (decision.j_values[0], decision.j_values[WAIT]) == (1.0, 0.0)
    assert decision.explanations[WAIT].conjunct == "F[0,3] x > 0.4"
    assert "leaves as much of 'F[0,3] x > 0.4'" in decision.explanations[WAIT].detail


@pytest.mark.parametrize(("turns", "asked"), [(2, 5 * 6), (60, 42)])
def test_of_many_forbidden_actions_no_more_ways_are_asked_for_than_of_a_few(turns, asked):
    angles = (math.pi * k / turns for k in range(1, turns + 1))
    moves = [{"name": "wait"}, {"name": "go", "translate": 0.2}, {"name": "back", "translate": -0.2}]
    actions = [*moves, *({"name": f"turn{k}", "rotate": angle} for k, angle in enumerate(angles))]
    robot = robot_from_json({"footprint": {"radius": 0.1}, "actions": actions})
    grid, place = OccupancyGrid(np.zeros((99, 99)), 0.05), {"type": "circle", "center": [4, 4], "radius": 0.1}
    policy = Counted(make_task(grid, robot, "F[0,60] A", {"A": place}))
    history = np.tile([1.0, 1.0, 0.0], (58, 1))  # too late for all
    shield, logits = make_shield([policy]), np.zeros(len(actions))
    decide(shield, history, logits)
    before = policy.asked
    found = decide(shield, history, logits, explain=explanations).explanations
    assert None not in found
    assert policy.asked - 2 * before == asked


class Counted:
    """Proposes to stand, and counts how often it is asked."""

    id, asked = "counted", 0

    def __init__(self, task):
        self.task = task

    def propose(self, history, signals, margin):
        self.asked += 1
        count = len(self.task.robot.motions)
        motions = np.zeros((count, self.task.horizon + 1 - len(history)), np.int64)
        motions[:, 0] = np.arange(count)
        return Proposal(motions, 0)


@pytest.mark.parametrize(
    ("formula", "now", "changes"),
    [
        ("G[0,9] (not B or e > 0.5)", 1.0, True),
        ("G[0,9] (not B or e > 0.5)", 0.0, False),
        ("G[0,9] (e > 0.5 -> not B)", 0.0, True),
        ("G[0,9] (e > 0.5 -> not B)", 1.0, False),
        ("G[0,9] (e > 0.5 -> F[0,0] not B)", 0.0, True),
        ("G[0,9] not B and G[0,9] (e > 0.5 -> F[0,9] not B)", 0.0, False),
    ],
)
def test_what_fails_only_if_a_signal_changes_is_told_as_such(formula, now, changes):
    beside = {"B": {"type": "rectangle", "min": [0.8, 0.0], "max": [1.0, 0.6]}}
    task = make_task(
        OccupancyGrid(np.zeros((12, 24), bool), 0.05), ROBOT, formula, beside, signals={"e": now}
    )
    shield = make_shield([planner.synthesise(task)], Config(uncertainty=Uncertainty(), any_signal=True))
    told = decide(shield, [(0.7, 0.3, 0.0)], EVEN, explain=explanations).explanations[FORWARD]
    assert "B" in told.conjunct
    assert told.robustness < 0.0
    assert (told.detail or "").endswith(", if the signal e changes") == changes
