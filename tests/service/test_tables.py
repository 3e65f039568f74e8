"""Tables for a session's own map."""

import threading

import numpy as np

from evaluation.shipped import shipped
from specshield.service.heavy import tables as module
from specshield.service.heavy.tables import Tables, make
from specshield.shield.decision import make_shield
from specshield.sim.cases import load_case
from specshield.world.learned import LearnedMap
from tests.serving import wait_for


def test_a_session_goes_on_without_tables_that_cannot_be_made_and_does_not_try_again_for_the_same_map():
    shield, tables = make_shield([shipped(load_case("case1"), "reachability")]), Tables()
    nowhere = np.array([shield.task.grid.occupied.size])  # no cell of the map
    for cells in (nowhere, nowhere + 1):
        known = LearnedMap(1, cells, np.array([True]), np.array([0]), np.array([0]))
        assert tables.of("a session", shield, known, "") == (shield, None)
        _, made = begun = tables._last.peek("a session")
        wait_for(made.done)
        for _ in range(2):
            assert tables.of("a session", shield, known, "") == (shield, None)
            assert tables._last.peek("a session") == begun


def test_a_step_does_without_tables_while_no_thread_can_be_started(monkeypatch):
    shield, tables = make_shield([shipped(load_case("case1"), "reachability")]), Tables()
    known = LearnedMap(1, np.array([0]), np.array([True]), np.array([0]), np.array([0]))

    def none_left(thread):
        raise RuntimeError("can't start new thread")

    with monkeypatch.context() as patch:
        patch.setattr(threading.Thread, "start", none_left)
        assert tables.of("a session", shield, known, "") == (shield, None)
    wait_for(lambda: tables.of("a session", shield, known, "")[1] == known.digest)


def test_tables_take_no_more_memory_than_they_may_and_are_not_made_in_circles(monkeypatch):
    """A planner's fields take 20 to 100 MB: those of 64 sessions took gigabytes."""
    shield = make_shield([shipped(load_case("case1"), "reachability")])
    known = LearnedMap(1, np.array([0]), np.array([True]), np.array([0]), np.array([0]))
    one = make(shield, known).size
    assert 100_000 < one < 10_000_000
    monkeypatch.setattr(module, "ROOM", 2.5 * one)
    tables, sessions = Tables(), [f"session {i}" for i in range(4)]

    def ask(session):
        return tables.of(session, shield, known, "")[1]

    for session in sessions:
        assert ask(session) is None
        wait_for(tables._last.peek(session)[1].done)
    for _ in range(2):
        assert [ask(session) for session in sessions] == [None, None, known.digest, known.digest]
    assert all(tables._last.peek(session)[1].done() for session in sessions)
