"""Latest feasible times, phases and sets of goals, worked out by hand on a corridor."""

from __future__ import annotations

import numpy as np

from specshield.policy.lattice import NO_TIME, holds_at, make_lattice
from specshield.policy.progress import ALWAYS, make_rules
from specshield.policy.reachability.latest import (
    LEAST_LATE,
    Phase,
    lateness,
    latest_times,
    masks_of,
    phases_of,
)
from specshield.policy.reachability.policy import Settings, synthesise
from specshield.policy.reachability.tables import LATE
from specshield.robot import robot_from_json
from specshield.robot.dynamics import make_body
from specshield.task import make_task
from specshield.world.occupancy import OccupancyGrid
from tests.oracles.cells import CELL
from tests.policy.reachability.corridor import EAST, NORTH, SOUTH, WEST, guide_of, make_corridor, pose


def latest(formula, **cells):
    """L of each phase and set of settled goals, [phases, {mask: L [6 columns, 4 headings]}]."""
    task = make_corridor(formula, **cells)
    body, rules = make_body(task.robot, task.grid), make_rules(task)
    lattice = make_lattice(body, CELL)
    masks, phases = masks_of(rules), phases_of(rules, task.horizon)
    found, _ = latest_times(lattice, rules, holds_at(body, rules, lattice), masks, phases)
    return [{mask: found[i, n, 0] for n, mask in enumerate(masks)} for i in range(len(phases))]


def test_a_visit_by_a_deadline():
    """Each cell and each quarter turn costs a step."""
    (tables,) = latest("F[0,10] A", A=5)
    assert tables[0][:, EAST].tolist() == [5, 6, 7, 8, 9, 10]
    assert tables[0][:, NORTH].tolist() == [4, 5, 6, 7, 8, 10]
    assert tables[0][:, SOUTH].tolist() == tables[0][:, NORTH].tolist()
    assert tables[0][:, WEST].tolist() == [3, 4, 5, 6, 7, 10]
    assert (tables[1] == 10).all()  # settled: the phase's end


def test_a_visit_too_far_for_its_deadline():
    (tables,) = latest("F[0,3] A", A=5)
    assert tables[0][:, EAST].tolist() == [NO_TIME, NO_TIME, 0, 1, 2, 3]


def test_one_visit_and_then_another():
    """A by step 4, B from 4 to 12: before A is settled its deadline binds; then what is left to B does."""
    (tables,) = latest("F[0,4] A and F[4,12] B", A=1, B=5)
    assert tables[0][:2, EAST].tolist() == [3, 4]
    assert tables[1][:, EAST].tolist() == [7, 8, 9, 10, 11, 12]


def test_a_dwell_ends_in_time_for_what_follows():
    """F[0,4] G[0,2] A: three steps in A, begun by step 4. B, four cells on, by step 8: begun by step 2."""
    (tables,) = latest("F[0,4] G[0,2] A and F[0,8] B", A=1, B=5)
    assert tables[0][1, EAST] == 2  # in A until step 4, then four cells
    assert tables[0][0, EAST] == 1
    assert tables[2][1, EAST] == 4  # with B behind it, only the dwell is left


def test_an_always_makes_phases_with_tables_of_their_own():
    """C, on the way to A, may not be entered before step 4, which is the latest time to be there."""
    before, after = latest("F[0,6] A and G[0,3] not C", A=5, C=3)
    assert after[0][:, EAST].tolist() == [NO_TIME, NO_TIME, NO_TIME, 4, 5, 6]
    assert before[0][:, EAST].tolist() == [1, 2, 3, NO_TIME, 3, 3]  # the phase ends at step 3


def test_the_phases_of_a_rule():
    rules = make_rules(make_corridor("F[0,6] A and G[2,4] not C", A=5, C=3))
    (k,) = np.flatnonzero(rules.kind == ALWAYS)
    assert phases_of(rules, 6) == (Phase(0, 1, ()), Phase(2, 4, (int(k),)), Phase(5, 6, ()))


def test_which_goals_can_be_settled_before_others():
    """B's window begins after A's ends, so B is never settled while A is not."""
    rules = make_rules(make_corridor("F[0,3] A and F[4,7] B", A=1, B=5))
    assert masks_of(rules) == [3, 1, 0]
    rules = make_rules(make_corridor("F[0,4] A and F[4,7] B", A=1, B=5))
    assert sorted(masks_of(rules)) == [0, 1, 2, 3]


def test_how_far_the_tables_err():
    """At the crossings they are exact. Strides of a tenth of the pitch are seen a few steps wrong."""
    guide = guide_of(make_corridor("F[0,10] A", A=5))
    exact = np.array([pose(column, heading) for column in range(6) for heading in range(4)])
    assert lateness(guide, 12, exact) == LEAST_LATE
    body = {"footprint": {"radius": 0.2}}
    moves = [{"name": "on", "translate": 0.03}, {"name": "wait"}]
    turns = [{"name": name, "rotate": angle} for name, angle in (("left", 0.1), ("right", -0.1))]
    short = robot_from_json(body | {"actions": [*moves, *turns]})
    region = {"A": {"type": "circle", "center": [3.0, 1.5], "radius": 0.5}}
    task = make_task(OccupancyGrid(np.zeros((30, 40), bool), 0.1), short, "F[0,200] A", region)
    assert synthesise(task, Settings(pitch=0.9)).tables.late < LATE
