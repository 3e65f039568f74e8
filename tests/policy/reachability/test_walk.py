"""Tables' codes, the slack of a pose, one climb, one way rejoined, one beam: by hand, on a corridor."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from specshield.compiled import box
from specshield.policy.lattice import STEP_CODES
from specshield.policy.progress import BROKEN, PENDING, SETTLED, Past
from specshield.policy.reachability.beam import Terms, beam_search
from specshield.policy.reachability.guide import make_scratch, update_progress
from specshield.policy.reachability.policy import Settings, synthesise
from specshield.policy.reachability.search import begin, continue_all, go_back
from specshield.policy.reachability.tables import HOPELESS, SAFE, score, slack
from specshield.policy.reachability.walk import SETTLED_ALL, climb
from specshield.robot.dynamics import motion_count, step, successors
from tests.oracles.cells import CELL, FORWARD, LEFT, RIGHT, ROBOT, WAIT
from tests.policy.reachability.corridor import EAST, NORTH, RESTLESS, WEST, guide_of, make_corridor, pose


@pytest.fixture(scope="module")
def visit():
    """A is one cell, which a lattice hardly sees: its tables take A for kept from the cell before it on."""
    return guide_of(make_corridor("F[0,10] A", A=5))


def begun(guide, first, motion, t=0):
    """Room for a way from step t, its first motion made, with the progress that belongs to it."""
    steps = len(guide.tables.phase) - 1 - t
    motions, poses = np.full(steps, -1), np.zeros((steps, 3))
    scratch = scratch_of(guide, PENDING, 0)
    motions[0], poses[0] = motion, first
    update_progress(guide.rules, t + 1, *poses[0], scratch)
    return motions, poses, scratch


def every(motions):
    """Every first motion is wanted, however late."""
    return np.ones(motions, np.bool_), -np.inf


def scratch_of(guide, status, run):
    scratch = make_scratch(guide.rules, motion_count(guide.body))
    scratch.status[:], scratch.run[:] = status, run
    return scratch


def slack_at(guide, where, t, status=PENDING, run=0):
    return slack(guide, *where, t, scratch_of(guide, status, run))


def test_the_codes_of_the_tables(visit):
    tables = visit.tables
    assert tables.cell[0].tolist() == [0, 1, 2, 3, 4, 5]
    assert tables.table.tolist() == [[0, -1]]  # nothing is left to do once A is settled: no table
    assert tables.code[0, :, EAST].tolist() == [1 + STEP_CODES * latest for latest in (6, 7, 8, 9, 10, 10)]


def test_the_slack_of_a_pose(visit):
    assert slack_at(visit, pose(1), 2) == 5.0  # five steps away at the latest time 7
    assert slack_at(visit, pose(1), 9) == -2.0
    assert slack_at(visit, pose(1) + np.array([0.1, 0.0, 0.0]), 2) == pytest.approx(
        5.5
    )  # half way to the next cell
    assert slack_at(visit, pose(1), 2, SETTLED) == SAFE
    assert slack_at(visit, pose(1), 2, BROKEN) == HOPELESS


def test_a_dwell_under_way_leaves_what_comes_after_it():
    """Two of three steps in A are over at step 3; then there are four cells to B by step 12."""
    guide = guide_of(make_corridor("F[0,4] G[0,2] A and F[0,12] B", A=1, B=5))
    here = slack(guide, *pose(1), 3, scratch_of(guide, PENDING, [2, 0]))
    assert here == 12 - 4 - 3  # it is over at step 4, and the cell before B will do


def scored(guide, where, t, scratch, last=-1, some=(0, 1)):
    score(guide, *where, t, last, some, scratch)
    return scratch.scores.tolist()


def test_the_score_of_each_motion(visit):
    scratch = scratch_of(visit, PENDING, 0)
    assert scored(visit, pose(2), 0, scratch) == pytest.approx([9.0, 7.0, 7.0, 8.0])
    assert scored(visit, pose(2), 0, scratch, LEFT)[RIGHT] == HOPELESS
    one_in_two = scored(visit, pose(2), 0, scratch, some=(1, 2))
    assert one_in_two == pytest.approx([HOPELESS, 7.0, HOPELESS, 8.0])


def test_a_score_is_the_slack_where_the_motion_ends_to_the_last_bit(visit):
    where, ends, scratch = (
        pose(2) + np.array([0.03, 0.0, 0.0]),
        np.empty((4, 3)),
        scratch_of(visit, PENDING, 0),
    )
    successors(visit.body, where, ends)
    assert [latest - 1 for latest in scored(visit, where, 0, scratch)] == [
        slack_at(visit, end, 1) for end in ends
    ]


def test_a_climb_turns_goes_and_stays(visit):
    """Having turned left from west it turns on to east, whichever way; then it goes four cells and waits."""
    motions, poses, scratch = begun(visit, pose(1, WEST), WAIT)
    outcome, n = climb(visit, 0, 1, motions, poses, scratch, True)
    assert (outcome, n) == (SETTLED_ALL, 7)
    assert motions[1] == motions[2]
    assert motions[1] in (LEFT, RIGHT)
    assert motions[3:].tolist() == [FORWARD] * 4 + [WAIT] * 3
    np.testing.assert_allclose(poses[-1, :2], pose(5)[:2])


def test_a_climb_is_in_time_for_what_is_yet_to_begin():
    """It does not wait before A for step 8, as the tables would have it: their latest time there is 7."""
    guide = guide_of(make_corridor("G[8,10] A", A=3))
    motions, poses, scratch = begun(guide, pose(0), WAIT)
    outcome, _ = climb(guide, 0, 1, motions, poses, scratch, True)
    assert outcome == SETTLED_ALL
    assert motions[:7].tolist() == [WAIT] + [FORWARD] * 3 + [WAIT] * 3


def test_a_climb_waits_where_what_leads_deeper_is_cut_short():
    """A wall leaves 1.5 cm of the move ahead, which counts for none."""
    guide = guide_of(make_corridor("G[8,10] x > 1.0", robot=replace(ROBOT, on_contact="stop")))
    end = step(guide.body, *pose(5), FORWARD)
    here = np.array([end[0] - 0.015, *end[1:]])
    assert step(guide.body, *here, FORWARD)[0] == pytest.approx(end[0], abs=1e-3)
    motions, poses, scratch = begun(guide, here, WAIT)
    outcome, _ = climb(guide, 0, 1, motions, poses, scratch, True)
    assert outcome == SETTLED_ALL
    assert FORWARD not in motions


def test_a_way_is_rejoined_after_a_turn_is_undone(visit):
    """The base goes on in two cells; a left turn costs two steps, which come off its last waits."""
    base, led, scratch = begun(visit, pose(4), FORWARD)
    climb(visit, 0, 1, base, led, scratch, True)
    assert base.tolist() == [FORWARD, FORWARD] + [WAIT] * 8
    motions, poses = np.empty((4, 10), np.int64), np.empty((4, 10, 3))
    starts = begin(visit, past_at(3), every(4)[0], motions, poses)
    assert go_back(visit, LEFT, base, led, starts)
    assert motions[LEFT].tolist() == [LEFT, RIGHT, FORWARD, FORWARD] + [WAIT] * 6
    np.testing.assert_allclose(poses[LEFT, 3], pose(5))


def beam_from(guide, t, roots, steps, terms):
    """The ways of a beam from poses at step t, with nothing settled."""
    status, run = np.full((len(roots), 1), PENDING, np.int8), np.zeros((len(roots), 1), np.int64)
    return beam_search(guide, t, roots, status, run, steps, terms, make_scratch(guide.rules, 4))


def test_a_beam_of_two_roots_ends_where_the_goal_is(visit):
    """One root is a cell before A and faces it, the other faces north; a beam from step 6 has four steps."""
    roots = np.array([pose(4), pose(4, 1)])
    motions, taken = beam_from(visit, 6, roots, 4, Terms(4, 0.0, np.inf, 1))
    assert taken.tolist() == [1, 2]
    assert motions[0, 0] == FORWARD
    assert motions[1, :2].tolist() == [RIGHT, FORWARD]


def test_a_beam_that_looks_at_one_motion_in_two_looks_at_the_others_a_step_later(visit):
    """Two cells before A: it goes on, waits where it does not look at going on, and goes on then."""
    motions, taken = beam_from(visit, 5, pose(3)[None], 5, Terms(2, 0.0, np.inf, 2))
    assert motions[0, : taken[0]].tolist() == [FORWARD, WAIT, FORWARD]


def test_a_beam_gives_up_what_comes_too_late(visit):
    _, taken = beam_from(visit, 9, pose(3)[None], 1, Terms(4, 0.0, np.inf, 1))
    assert taken.tolist() == [0]


def past_at(cell):
    return Past(0.0, pose(cell)[None], np.empty((1, 0)))


def test_a_continuation_after_each_first_motion(visit):
    motions, poses = np.empty((4, 10), np.int64), np.empty((4, 10, 3))
    best = continue_all(box(visit), 0.0, 12, past_at(0), *every(4), motions, poses)
    assert best == FORWARD
    assert motions[:, 0].tolist() == [FORWARD, LEFT, RIGHT, WAIT]
    np.testing.assert_allclose(poses[:, -1, 0], pose(5)[0])  # five cells in at most ten steps, after each


def test_a_robot_that_cannot_wait_is_there_at_the_one_step_asked_for():
    """Two cells from A, which it has to be in at step 4: four steps for two cells, the rest are turns."""
    guide = guide_of(make_corridor("F[4,4] A", RESTLESS, A=5))
    assert guide.wait == -1
    motions, poses = np.empty((3, 4), np.int64), np.empty((3, 4, 3))
    continue_all(box(guide), 0.0, 12, past_at(3), *every(3), motions, poses)
    np.testing.assert_allclose(poses[:, -1, 0], pose(5)[0])
    assert sorted(motions[1].tolist()) == [FORWARD, FORWARD, LEFT, RIGHT]


def test_ways_for_an_earlier_deadline_are_proposed_after_the_motions_that_are_asked_for():
    """A is five cells from x_0, and asked for within 5 steps in place of 10."""

    def earlier(formula, motion, heading=EAST, **more):
        task = make_corridor(formula, **more)
        wanted = np.arange(len(task.robot.motions)) == motion
        policy = synthesise(task, Settings(pitch=CELL * 3)).earlier(5, wanted)
        return policy.propose(pose(0, heading)[None], {}, 0.0).motions

    assert earlier("F[0,10] A", FORWARD, A=5)[:, :5].tolist() == [[FORWARD] * 5]
    assert earlier("F[0,10] A", LEFT, NORTH, A=5).shape == (0, 10)  # that is three turns and five cells
    for both in ("F[0,10] A and F[10,11] B", "F[10,11] B and F[0,10] A"):  # a window of two steps stays
        assert earlier(both, FORWARD, A=5, B=5)[:, :5].tolist() == [[FORWARD] * 5]
    assert earlier("G[0,10] A", FORWARD, A=0).shape == (0, 10)  # nothing has a deadline
    assert earlier("F[0,10] A", FORWARD, robot=RESTLESS, A=5).shape == (0, 10)
