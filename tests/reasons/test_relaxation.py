"""What is said of the conjuncts of a rule that cannot be kept is true: held against every future on cells."""

import math
from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest

from specshield.episode import Config, decide, make_shield
from specshield.episode.handover import begun
from specshield.errors import InfeasibleStart
from specshield.policy.planner.policy import Settings as Plan
from specshield.policy.planner.policy import synthesise as synthesise_plans
from specshield.policy.reachability.policy import synthesise
from specshield.reasons.lateness import driven
from specshield.reasons.refusal import begin, refusal
from specshield.reasons.relaxation import relaxations, way
from specshield.reasons.smaller import STEP, kept_out, most_steps, smaller
from specshield.robot import robot_from_json
from specshield.stl import parse
from specshield.task import make_task
from specshield.world.occupancy import OccupancyGrid
from specshield.world.regions import Circle, Polygon, Rectangle, Union, signed_distance
from tests.oracles.cells import CELL, ROBOT, STATES, Cells, Scripted, waits, ways
from tests.reasons.rules_on_cells import dwells, until, visits

PLACES = {"A": (2, 0), "B": (0, 2), "C": (4, 4), "D": (1, 0)}


def cells_of(parts):
    return visits(parts, PLACES)[0]


def steps_late(told):
    return told.late and told.late.steps


def exists(parts, history):
    return bool(cells_of(parts).feasible(history).any())


def test_each_conjunct_alone_and_how_late_it_is():
    random, seen = np.random.default_rng(3), {"alone": 0, "beside": 0, "unknown": 0}
    for _ in range(60):
        a, b, c = (int(v) for v in random.integers(1, 5, 3))
        parts = [("F", 0, a, "A"), ("F", min(b, c), max(b, c), "B"), ("G", 0, 4, "D")]
        parts = [parts[i] for i in sorted(random.permutation(3)[: random.integers(1, 4)])]
        cells = cells_of(parts)
        history = np.array([cells.pose(int(random.integers(0, 3)), 0, int(random.integers(4)))])
        if exists(parts, history):
            continue
        relaxed = relaxations(make_shield([Scripted(cells, waits)]), history, {})
        assert relaxed.way is None
        for part, told in zip(parts, relaxed.conjuncts, strict=True):
            op, start, end, place = part
            others = [other for other in parts if other != part]
            assert told.feasible_alone == exists([part], history)
            assert (told.robustness > 0.0) <= told.feasible_alone
            if steps_late(told) is None:
                seen["unknown"] += 1
                continue
            beside = others if told.feasible_alone else []
            seen["beside" if beside else "alone"] += 1
            assert end + steps_late(told) > 6 or exists(
                [*beside, (op, start, end + steps_late(told), place)], history
            )
            assert not exists([*beside, (op, start, min(end + steps_late(told) - 1, 6), place)], history)
    assert min(seen.values()) >= 3, seen


def depths(region, smaller, grown, history, n=6):
    """How deep [m] each of all n motions' poses are in a region that is so much smaller, as in `Cells`."""
    cells = cells_of([("F", 0, 6, "A")])
    now = np.full(len(ways(n)), STATES.index(cells.state(history[-1])))
    at = [now] + [now := cells.table[now, column] for column in ways(n).T]
    x, y = (np.array(STATES)[np.array(at).T, :2] + 0.5).transpose(2, 0, 1) * CELL
    if region["type"] == "circle":
        distance = np.hypot(x - region["center"][0], y - region["center"][1])
        return region["radius"] - smaller - distance + grown
    low, high = np.array(region["min"]) + smaller, np.array(region["max"]) - smaller
    dx, dy = np.minimum(x - low[0], high[0] - x), np.minimum(y - low[1], high[1] - y)
    return np.where((dx < 0) & (dy < 0), -np.hypot(dx, dy), np.minimum(dx, dy)) + grown


def test_how_much_smaller_a_keep_out_has_to_be_and_a_session_begins_with_it_so():
    """Also two regions of one keep-out, of which one is far from every way."""
    random, seen = np.random.default_rng(11), {"alone": 0, "beside": 0, "unknown": 0, "two": 0}
    far = {"type": "circle", "center": [0.9, 0.9], "radius": 0.05}
    place_a = {"type": "rectangle", "min": [0.4, 0.0], "max": [0.6, 0.2]}
    for k in range(120):
        (x, y), r, end = random.uniform(0.1, 0.9, 2).round(2), float(random.uniform(0.1, 0.4)), 3 + k % 4
        region = {"type": "circle", "center": [x, y], "radius": r}
        if k % 2:
            region = {"type": "rectangle", "min": [x - r, y - r / 2], "max": [x + r, y + r / 2]}
        grown, out = (0.09, "touches(K)") if k % 3 else (0.0, "K")
        away = bool(random.integers(2)) and k % 5 > 0
        keeps_out = f"G[{k % 3},6] not ({out} or L)" if away else f"G[{k % 3},6] not {out}"
        cells = cells_of([("F", 0, 6, "A")])
        regions = {**cells.task.regions, "K": region, **({"L": far} if away else {})}
        task = make_task(cells.task.grid, ROBOT, f"F[0,{end}] A and {keeps_out}", regions)
        history = np.array([cells.pose(int(random.integers(0, 3)), 0, int(random.integers(4)))])
        reaches = (depths(place_a, 0.0, 0.0, history)[:, : end + 1] > 0.0).any(axis=1)
        size = int(100 * (r if region["type"] == "circle" else r / 2) - 1e-6)
        beside = depths(far, 0.0, 0.0, history) < 0.0 if away else True
        out_of = [
            ((depths(region, 0.01 * steps, grown, history) < 0.0) & beside)[:, k % 3 :].all(axis=1)
            for steps in range(size + 1)
        ]
        if (out_of[0] & reaches).any():
            continue
        shield = make_shield([Scripted(SimpleNamespace(task=task), waits)])
        visit, kept = relaxations(shield, history, {}).conjuncts
        assert (visit.feasible_alone, kept.feasible_alone) == (reaches.any(), out_of[0].any())
        both = reaches if visit.feasible_alone and kept.feasible_alone else True
        enough = [steps for steps, out in enumerate(out_of) if (out & both).any()]
        if (kept.feasible_alone and not visit.feasible_alone) or not enough:
            assert kept.smaller is None
            seen["unknown"] += 1
            continue
        seen["alone" if both is True else "beside"] += 1
        seen["two"] += away
        assert kept.smaller.by == pytest.approx(0.01 * enough[0])
        assert kept.smaller.regions.keys() == {"K"}
        formula = task.formula if kept.smaller.only else kept.formula
        assert kept.smaller.only == bool((out_of[enough[0]] & reaches).any())
        made = make_task(task.grid, ROBOT, str(formula), {**regions, **kept.smaller.regions})
        feasible, _ = begin(make_shield([Scripted(SimpleNamespace(task=made), waits)]), history[0], False)
        assert feasible
    assert min(seen.values()) >= 5, seen


def test_a_smaller_region_is_the_points_so_deep_in_it():
    """Of a polygon with a corner that points inwards: a part of them."""
    random, points, seen = np.random.default_rng(2), np.random.default_rng(3).uniform(-1.2, 1.2, (400, 2)), 0
    for k in range(60):
        n = 4 + k % 7
        angle = (np.arange(n) + random.uniform(0.0, 0.7, n)) * (2 * np.pi / n)
        far = 1.0 if k % 2 else random.uniform(0.3, 1.0, n)
        corners = np.column_stack([far * np.cos(angle), far * np.sin(angle)])
        region = Polygon(tuple(map(tuple, corners[:: 1 if k % 3 else -1].tolist())))
        depth, most = signed_distance(region, points), most_steps(region)
        assert smaller(region, most + 1) is None
        for steps in {1, most // 2, most} - {0}:
            inside = signed_distance(smaller(region, steps), points) > 0.0
            assert (depth[inside] > STEP * steps - 1e-4).all()
            if k % 2:  # it is convex
                seen += 1
                assert inside[depth > STEP * steps + 1e-4].all()
    assert seen > 60
    outer = (
        [(0.0, 0.9), (0.5, 0.9), (0.5, 1.5), (1.1, 1.5)],
        [(1.8, 1.0), (2.7, 1.0), (2.7, -0.4), (0.0, -0.4)],
    )
    notched = Polygon((*outer[0], (1.1, 0.3), (1.8, 0.3), *outer[1]))
    assert smaller(notched, 30) is None  # its corners would be so deep, but an edge would cross the notch
    parts = Union((Circle((0.0, 0.0), 0.055), Rectangle((1.0, 1.0), (3.0, 2.0))))
    assert smaller(parts, 3) == Union((Circle((0.0, 0.0), 0.025), Rectangle((1.03, 1.03), (2.97, 1.97))))
    assert smaller(parts, 40) == Union((Rectangle((1.4, 1.4), (2.6, 1.6)),))
    assert (most_steps(parts), smaller(parts, 50)) == (49, None)
    rule, many = parse("G[0,6] not (A or B)"), Union((Circle((0.0, 0.0), 1.0),) * 666)
    assert kept_out(rule, {"A": parts, "B": parts}) == ("A", "B")
    assert kept_out(rule, {"A": parts, "B": many}) == ()  # they would take long


@pytest.mark.parametrize(
    ("part", "names"),
    [
        ("G[0,9] not (touches(K) or L or x > 2 and K)", ("K", "L")),
        ("G[0,9] (not inside(L) and battery > 1)", ("L",)),
        ("not K U[0,9] L", ("K",)),
        ("not L", ("L",)),
        ("G[0,9] (L -> not K)", ()),
        ("G[0,9] K", ()),
        ("F[0,9] not K", ()),
        ("G[0,9] F[0,3] not K", ()),
    ],
)
def test_what_a_part_of_a_rule_keeps_out_of(part, names):
    assert kept_out(parse(part), {name: Circle((0.0, 0.0), 1.0) for name in "KL"}) == names


def test_how_late_an_until_and_a_place_to_be_in_come():
    seen = 0
    for column, heading in ((0, 1), (0, 2), (3, 0), (3, 1), (3, 3)):
        for rule, at in ((until, 1), (dwells, 2)):
            cells = rule(at)
            history = np.array([cells.pose(column, 0, heading)])
            if cells.feasible(history).any():
                continue
            (told,) = relaxations(make_shield([Scripted(cells, waits)]), history, {}).conjuncts
            if steps_late(told) is not None:
                seen += 1
                assert rule(at + steps_late(told)).feasible(history).any()
                assert not rule(at + steps_late(told) - 1).feasible(history).any()
    assert seen >= 4


def _from(inside, step):
    return {name: values[..., step:] for name, values in inside.items()}


def _every(steps, window, place, since=0):
    return lambda s: np.all(
        [s[place][..., k + since : k + window + 1].any(-1) for k in range(steps + 1)], axis=0
    )


@pytest.mark.parametrize(
    ("which", "rule"),
    [
        (0, lambda late: (f"G[0,4] F[0,{1 + late}] A", _every(4, 1 + late, "A"))),
        (0, lambda late: (f"G[1,5] F[1,{2 + late}] A", lambda s: _every(4, 2 + late, "A", 1)(_from(s, 1)))),
        (
            1,
            lambda late: (
                f"F[0,3] D and G[0,4] (D -> F[0,{1 + late}] A)",
                lambda s: (
                    s["D"][..., :4].any(-1)
                    & np.all(
                        [~s["D"][..., k] | s["A"][..., k : k + 2 + late].any(-1) for k in range(5)], axis=0
                    )
                ),
            ),
        ),
        (
            0,
            lambda late: (
                f"F[0,{1 + late}] (A and F[1,3] D)",
                lambda s: np.any(
                    [s["A"][..., k] & s["D"][..., k + 1 : k + 4].any(-1) for k in range(2 + late)], axis=0
                ),
            ),
        ),
    ],
)
def test_a_later_end_that_is_named_is_the_first_that_is_enough_and_a_session_begins_with_it(which, rule):
    """Patrols and responses were read at few of their steps: an end named for them was refused when it was
    asked for, or was some thirty steps later than it had to be.
    """
    places, seen = {name: PLACES[name] for name in ("AD" if "D" in rule(0)[0] else "A")}, set()
    for i, j, heading in [(0, 0, 2), (3, 0, 0), (2, 2, 1), (0, 2, 3), (1, 0, 1), (4, 1, 0), (0, 1, 2)]:
        cells = [Cells(*rule(late), places) for late in range(5)]
        history = np.array([cells[0].pose(i, j, heading)])
        enough = [bool(each.feasible(history).any()) for each in cells if each.task.horizon <= 8]
        if enough[0]:
            continue
        told = relaxations(make_shield([Scripted(cells[0], waits)]), history, {})
        late = steps_late(told.conjuncts[which])
        seen.add(late)
        assert late == enough.index(True) if True in enough else late is None or late >= len(enough)
        if late is not None:
            eased = Cells(*rule(late), places)
            feasible, _ = begin(make_shield([Scripted(eased, waits)]), history[0].tolist(), False)
            assert feasible
            for longest in (eased.task.horizon, eased.task.horizon - 1):
                shield = make_shield([Scripted(cells[0], waits)], Config(max_steps=longest))
                with pytest.raises(InfeasibleStart) as refused:
                    begin(shield, history[0].tolist(), False)
                named = refused.value.details["conjuncts"][which]["late_by"]
                assert named == (late if longest == eased.task.horizon else None)
    assert len(seen) >= 2, seen


@pytest.mark.parametrize(
    ("part", "keeps"),
    [
        (
            "G[0,4] (F[0,3] A or F[0,3] C)",
            lambda s: np.all([(s["A"] | s["C"])[..., k : k + 4].any(-1) for k in range(5)], axis=0),
        ),
        (
            "F[0,3] (A and F[1,2] not A)",
            lambda s: np.any(
                [s["A"][..., k] & ~s["A"][..., k + 1 : k + 3].all(-1) for k in range(4)], axis=0
            ),
        ),
    ],
)
def test_a_part_that_a_policy_can_keep_alone_is_not_blamed_for_another(part, keeps):
    """The search knows neither form of rule. C is 8 cells away, more than the other part's window allows."""
    places, rule = {name: PLACES[name] for name in "AC"}, f"{part} and F[0,3] C"
    alone, whole = Cells(part, keeps, places), Cells(rule, None, places)
    planned = make_shield([synthesise_plans(whole.task, Plan(pitch=CELL))])
    expected = set()
    for heading in range(4):
        history = np.array([whole.pose(0, 0, heading)])
        blamed, other = relaxations(planned, history, {}).conjuncts
        expected.add(bool(alone.feasible(history).any()))
        assert blamed.feasible_alone == bool(alone.feasible(history).any())
        assert not other.feasible_alone
    assert expected == {True, False}


def shield(parts):
    return make_shield([Scripted(cells_of(parts), waits)])


def test_a_refusal_says_which_of_both_it_is():
    history = np.array([cells_of([("F", 0, 9, "A")]).pose(0, 0, 0)])
    sealed = refusal(shield([("F", 0, 1, "A")]), history, {})
    assert sealed.proved
    assert sealed.message.startswith("no way from here keeps the rule: whatever the robot does, it breaks")
    (told,) = sealed.details["conjuncts"]
    assert (told["formula"], told["feasible_alone"], told["late_by"]) == ("F[0,1] A", False, 1)
    assert np.isclose(told["robustness"], -0.1)  # the middle of the next cell of 0.2 m


def test_a_way_that_the_policies_missed_is_not_denied():
    history = np.array([cells_of([("F", 0, 9, "A")]).pose(0, 0, 0)])
    missed = refusal(shield([("F", 0, 4, "A")]), history, {})
    assert not missed.proved
    assert "a search found one" in missed.message
    feasible, way = begin(shield([("F", 0, 4, "A")]), history[0], False)
    assert feasible
    first = decide(shield([("F", 0, 4, "A")]), history, None, True, carry=begun(way))
    assert first.mode == "completion"
    assert bytes([first.action, *first.witness]) == way


def test_what_was_not_found_is_not_called_impossible_and_a_later_end_that_would_do_is_named():
    parts = [("F", 0, 3, "A"), ("F", 0, 6, "B")]
    history = np.array([cells_of(parts).pose(0, 0, 0)])
    if exists(parts, history):
        parts = [("F", 0, 2, "A"), ("F", 0, 5, "B")]
    told = refusal(shield(parts), history, {})
    assert [each["feasible_alone"] for each in told.details["conjuncts"]] == [True, True]
    late = [each["late_by"] for each in told.details["conjuncts"]]
    assert any(late), late
    assert told.proved or "Each part can be kept alone, and all can with '" in told.message


def test_a_rule_that_is_over_and_was_not_kept_could_still_be_kept_later():
    parts = [("F", 0, 1, "A")]
    history = np.array([cells_of(parts).pose(0, 0, 0)] * 4)
    told = refusal(shield(parts), history, {})
    assert told.proved
    assert "F[0,1] A is broken already" in told.message or "breaks" in told.message
    assert steps_late(told.conjuncts[0]) == 4  # at step 5


def test_whoever_lands_exactly_on_an_edge_is_one_step_short():
    """On the edge rho is 0, which does not satisfy: the search has to go on to the next step."""
    free = np.zeros((60, 60), bool)
    robot = robot_from_json({"footprint": {"radius": 0.2}, "actions": [
        {"name": "forward", "translate": 0.25}, {"name": "left", "rotate": math.pi / 6}, {"name": "wait"},
        {"name": "end", "terminal": True}]})  # fmt: skip
    places = {"East": {"type": "rectangle", "min": [4.5, 0.0], "max": [6.0, 6.0]}}
    task = make_task(OccupancyGrid(free, 0.1), robot, "F[0,12] East", places)
    found = relaxations(make_shield([synthesise(task)]), np.array([[1.5, 1.5, 0.0]]), {})
    assert found.way is None
    assert (steps_late(found.conjuncts[0]), found.conjuncts[0].feasible_alone) == (1, False)


@pytest.mark.parametrize("heading", [1, 2, 3])
def test_a_place_that_some_of_every_square_may_be_in_is_gone_to(heading):
    """Squares of 0.2 m: those on the left of the edge reach over it, by the circles that bound them."""
    cells = Cells("G[0,5] F[0,5] x >= 0.2", None, {})
    shield, history = make_shield([Scripted(cells, waits)]), np.array([cells.pose(0, 2, heading)])
    found = way(shield, history, {})
    assert found is not None
    assert (driven(shield, history, found[None])[0, 5:, 0] >= 0.2).all()


def test_two_places_that_can_just_be_visited_in_time_are():
    """A step later the search met the first place too late, took that for a way, and looked no further."""
    turns = [("go", 0.2, 0.0), ("left", 0.0, math.pi / 6), ("right", 0.0, -math.pi / 6)]
    actions = [{"name": name, "translate": far, "rotate": turn} for name, far, turn in turns]
    robot = robot_from_json({"footprint": {"radius": 0.1}, "actions": actions})
    random, start, seen = np.random.default_rng(0), np.array([[2.0, 2.0, 0.0]]), 0

    def asked(formula, *places):
        regions = {
            name: {"type": "circle", "center": place.tolist(), "radius": 0.12}
            for name, place in zip("AB", places, strict=True)
        }
        task = make_task(OccupancyGrid(np.zeros((80, 80), bool), 0.05), robot, formula, regions)
        return make_shield([Scripted(SimpleNamespace(task=task), waits)])

    every = np.array(list(product(range(3), repeat=8)))
    poses = driven(asked("F[0,8] A or F[0,8] B", *start[[0, 0], :2]), start, every)[..., :2]
    for _ in range(300):
        a = start[0, :2] + random.uniform(-0.8, 0.8, 2)
        b = a + random.uniform(-0.8, 0.8, 2)
        in_a, in_b = (np.linalg.norm(poses - place, axis=2) < 0.12 - 1e-9 for place in (a, b))
        if not in_a[:, 1:].any():
            continue
        first = int(np.argmax(in_a.any(axis=0)))
        after = in_b[in_a[:, first], first:].any(axis=0)
        if after.any():
            seen += 1
            both = f"F[0,{first}] A and F[{first},{first + int(np.argmax(after))}] B"
            found = way(asked(both, a, b), start, {})
            assert found is not None, both
    assert seen > 30


def test_a_heading_that_can_be_had_is_feasible_alone():
    turns = [("go", 0.25, 0.0), ("left", 0.0, math.pi / 4), ("right", 0.0, -math.pi / 4), ("wait", 0.0, 0.0)]
    actions = [{"name": name, "translate": far, "rotate": turn} for name, far, turn in turns]
    robot = robot_from_json({"footprint": {"radius": 0.1}, "actions": actions})
    formula = "F[0,3] x > 9 and F[0,7] theta > 1 and F[0,1] theta < -1"
    task = make_task(OccupancyGrid(np.zeros((12, 40), bool), 0.25), robot, formula)
    waiting = make_shield([Scripted(SimpleNamespace(task=task), waits)])
    told = relaxations(waiting, np.array([[1.0, 1.0, 0.0]]), {}).conjuncts
    assert [each.feasible_alone for each in told] == [False, True, False]


@pytest.mark.parametrize(
    ("rule", "alone", "late"),
    [
        ("not (A U[0,4] (F[0,2] D)) and F[0,1] C", [True, False], 9),
        ("G[0,60] (F[20,40] B and F[20,40] A) and F[0,5] C", [False, False], 5),
        ("F[0,9] B and F[0,5] 1 > 2", [True, False], None),
    ],
)
def test_a_rule_of_which_much_a_negation_or_a_constant_is_left_is_refused_with_its_parts(rule, alone, late):
    """C is ten motions away. Without a bound on the work for what is left of it, the search for the second
    rule took more than 20 s.
    """
    cells = Cells(rule, None, PLACES)
    told = relaxations(make_shield([Scripted(cells, waits)]), np.array([cells.pose(0, 0, 2)]), {})
    assert [each.feasible_alone for each in told.conjuncts] == alone
    assert steps_late(told.conjuncts[1]) == late
