"""Tasks: what they read from a trajectory, their hash, and what is refused."""

from __future__ import annotations

import gc
import math
import pickle
import re
import weakref

import numpy as np
import pytest

from specshield import episode
from specshield.errors import FormulaError, HorizonError, MapError, SampleError
from specshield.policy.reachability.policy import synthesise
from specshield.robot import STRETCH, robot_from_json
from specshield.rule.view import look, view_of
from specshield.shield.decision import Config, make_shield
from specshield.shield.uncertainty import Uncertainty
from specshield.stl import robustness
from specshield.task import MAX_KEPT, kept_with_task, make_task
from specshield.world.occupancy import OccupancyGrid
from specshield.world.regions import Circle, region_from_json

GRID = OccupancyGrid(np.zeros((20, 20), bool), 0.1)
DISC = {"type": "circle", "center": [1.0, 1.0], "radius": 0.5}
BOX = {"type": "rectangle", "min": [0.0, 0.0], "max": [1.0, 2.0]}
CART = robot_from_json({"footprint": {"radius": 0.2}, "actions": [{"name": "go", "translate": 0.1}]})


def task_of(formula="F[0,3] A and G[0,2] theta < 1 and F[0,1] load > 0.5", grid=GRID, robot=STRETCH, **more):
    return make_task(grid, robot, formula, **({"regions": {"A": DISC}, "signals": {"load": 0.0}} | more))


def test_samples_of_a_trajectory():
    poses = np.array([[1.0, 1.0, 0.5], [1.5, 1.0, -3.0], [2.0, 1.0, math.pi], [1.0, 0.0, 0.0]])
    samples = task_of().samples(poses, {"load": np.array([0.1, 0.9])})
    assert sorted(samples) == ["A", "load", "theta"]
    np.testing.assert_allclose(samples["A"], [0.5, 0.0, -0.5, -0.5])
    assert samples["theta"].tolist() == [0.5, -3.0, math.pi, 0.0]
    assert samples["load"].tolist() == [0.1, 0.9, 0.9, 0.9]  # the last value is held
    assert task_of().samples(poses)["load"].tolist() == [0.0] * 4  # the declared one before any
    batch = task_of().samples(np.stack([poses, poses + 1.0]), {"load": np.array([0.1, 0.9])})
    assert {name: array.shape for name, array in batch.items()} == {
        "A": (2, 4),
        "theta": (2, 4),
        "load": (2, 4),
    }
    # min(max A, min(1 - theta over 0..2), max load - 0.5 over 0..1) = min(0.5, 1 - pi, 0.4)
    assert robustness(task_of().formula, samples) == pytest.approx(1 - math.pi)


def test_a_rule_may_be_about_the_body_instead_of_its_origin():
    formula = "F[0,3] inside(A) and G[0,2] not touches(Door)"
    task = task_of(formula, robot=CART, rooms={"Door": Circle((2.0, 2.0), 0.5)}, signals={})
    assert sorted(task.regions) == ["A", "Door"]
    # The disc about A has a radius of 0.5 m and the cart one of 0.2: inside up to 0.3 m from A's centre.
    samples = task.samples(np.array([[1.0, 1.0, 0.5], [1.4, 1.0, 0.5], [1.7, 1.0, 0.5]]))
    np.testing.assert_allclose(samples["inside(A)"], [0.3, -0.1, -0.4])
    np.testing.assert_allclose(samples["touches(Door)"][0], 0.7 - math.sqrt(2))
    # The Stretch's body lies 0.109 m behind its origin, so that it matters where the robot looks.
    ahead, back = task_of("F[0,1] touches(A)", signals={}).samples([[0.3, 1.0, 0.0], [0.3, 1.0, math.pi]])[
        "touches(A)"
    ]
    assert (ahead, back) == pytest.approx((0.5 - 0.809 + 0.1855, 0.5 - 0.591 + 0.1855))


def test_a_body_lies_to_regions_alone():
    for formula, said in (
        ("F[0,3] touches(load)", "'load' is not a region"),
        ("F[0,3] inside(x)", "'x' is not a region"),
        ("F[0,3] inside(Nowhere)", "'Nowhere' is not a region"),
        ("F[0,3] inside()", "expected the name of a region after 'inside('"),
        ("F[0,3] near(A)", "nothing declares 'near'"),
    ):
        with pytest.raises(FormulaError, match=re.escape(said)):
            task_of(formula)


def test_only_what_the_formula_names_is_kept_and_the_specs_own_comes_first():
    rooms = {"A": Circle((5.0, 5.0), 1.0), "Hall": Circle((6.0, 6.0), 1.0), "load": Circle((7.0, 7.0), 1.0)}
    task = task_of("F[0,3] (A and Hall) and F[0,2] load > 1", regions={"A": DISC, "B": BOX}, rooms=rooms)
    assert task.regions == {"A": region_from_json(DISC, "A"), "Hall": rooms["Hall"]}
    assert task.signals == {"load": 0.0}
    assert task.samples(np.zeros((4, 3)))["load"].tolist() == [0.0] * 4  # the signal, not the room
    assert task.horizon == 3


def test_the_hash_is_of_all_that_matters_and_nothing_else():
    same = task_of()
    assert task_of("(F[0:3] A) & G[0,2] theta<1 & F[0,1] load>0.5").content_hash == same.content_hash
    assert (
        task_of(regions={"B": BOX, "A": DISC}, signals={"load": 0, "extra": 1.0}).content_hash
        == same.content_hash
    )
    others = [
        task_of("F[0,4] A and G[0,2] theta < 1 and F[0,1] load > 0.5"),
        task_of(regions={"A": {**DISC, "radius": 0.6}}),
        task_of(signals={"load": 0.1}),
        task_of(robot=CART),
        task_of(grid=OccupancyGrid(np.zeros((20, 20), bool), 0.1, (0.0, 0.1, 0.0))),
    ]
    assert len({task.content_hash for task in (same, *others)}) == 6


@pytest.mark.parametrize(
    ("given", "error", "path"),
    [
        ({"formula": "F[0,3] Nowhere"}, FormulaError, None),
        ({"formula": "F[0,3] (A"}, FormulaError, None),
        ({"formula": "F[0,1001] A"}, HorizonError, None),
        ({"regions": {"A": {**DISC, "radius": -1}}}, MapError, "regions.A.radius"),
        ({"regions": {"x": DISC}}, MapError, "regions.x"),
        ({"regions": {"F": DISC}}, MapError, "regions.F"),
        ({"regions": {"a b": DISC}}, MapError, "regions.a b"),
        ({"regions": {"A" * 65: DISC}}, MapError, "regions." + "A" * 65),
        ({"regions": {f"A{i}": DISC for i in range(257)}}, MapError, "regions"),
        ({"regions": [DISC]}, MapError, "regions"),
        ({"regions": {"A": (1.0, 1.0, 0.5)}}, MapError, "regions.A"),
        ({"signals": ["load"]}, SampleError, "signals"),
        ({"signals": {"A": 1.0}}, SampleError, "signals.A"),
        ({"signals": {"theta": 1.0}}, SampleError, "signals.theta"),
        ({"signals": {"load": math.nan}}, SampleError, "signals.load"),
        ({"signals": {"load": "full"}}, SampleError, "signals.load"),
        ({"signals": {"load": True}}, SampleError, "signals.load"),
        ({"signals": {"load": 10**400}}, SampleError, "signals.load"),
    ],
)
def test_bad_specs_name_the_field(given, error, path):
    with pytest.raises(error) as caught:
        task_of(**{"formula": "F[0,3] A", **given})
    assert path is None or caught.value.path == path
    assert caught.value.expected


def test_a_rule_of_the_first_state_alone_is_a_task():
    assert task_of("x > 1").horizon == 0


def test_a_task_that_nobody_uses_any_more_goes_with_its_map_and_all_that_was_made_of_it():
    task = make_task(GRID, STRETCH, "F[0,3] A and G[0,2] theta < 1", {"A": DISC})
    shield = make_shield([synthesise(task)], Config(uncertainty=Uncertainty(), learn_map=True))
    decision = episode.decide(shield, [(1.0, 1.0, 0.0)], np.zeros(len(STRETCH.actions)))
    assert view_of(task, task.formula) is view_of(task, task.formula)
    gone = weakref.ref(task)
    del task, shield, decision
    gc.collect()
    assert gone() is None


def test_no_more_is_kept_with_a_task_than_its_bound():
    task, calls = task_of(), []

    @kept_with_task
    def counted(task, number):
        calls.append(number)
        return None if number == 0 else number

    assert [counted(task, 0), counted(task, 0)] == [None, None]
    assert [counted(task, number) for number in range(1, MAX_KEPT + 1)] == list(range(1, MAX_KEPT + 1))
    counted(task, 0)  # was the first to go
    assert calls == [0, *range(1, MAX_KEPT + 1), 0]


def test_a_task_is_sent_to_another_process_with_all_that_was_made_of_it():
    task = make_task(GRID, STRETCH, "F[0,3] A", {"A": DISC})
    view = view_of(task, task.formula)
    sent = pickle.loads(pickle.dumps(task))
    again = view_of(sent, sent.formula)
    assert again.value.last.tolist() == view.value.last.tolist() == [3]
    bounds = [
        look(each, np.array([[1.0, 1.0, 0.0]]), np.empty((1, 0)), np.empty(4)) for each in (view, again)
    ]
    assert bounds[0] == bounds[1]
