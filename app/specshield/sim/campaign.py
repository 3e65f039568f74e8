"""Runs many episodes of a case, from each start once with and once without the shield, several at a time."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from contextlib import contextmanager, suppress
from functools import cache
from multiprocessing import get_context, parent_process
from queue import SimpleQueue
from typing import Any, NamedTuple, TypeVar

import numpy as np

from specshield.client import Session, ShieldClient
from specshield.cores import cores
from specshield.errors import InfeasibleStart
from specshield.policy.dqn.environment import free_poses
from specshield.sim.cases import Case, load_case
from specshield.sim.episodes import Episode, with_shield, without_shield
from specshield.sim.learned.model import load_learned
from specshield.sim.robot import Pose

T = TypeVar("T")
PATIENCE = 60.0  # [s] for one decision: the machine may be busy
MOST_ROBOTS = 8  # processes at once, with 190 MB each; chosen by hand
DRAWS = 100  # starts that are tried for one episode


class Campaign(NamedTuple):
    """Pairs of episodes: `shielded[i]` and `unshielded[i]` have the same start and the same seed of the
    model.

    refused: the number of starts that the service refused as infeasible.
    """

    case: Case
    shielded: list[Episode]
    unshielded: list[Episode]
    refused: int

    @property
    def broken(self) -> list[Episode]:
        """The shielded episodes that did not satisfy the rule; the shield promises that there are none."""
        return [episode for episode in self.shielded if episode.spec_status != "satisfied"]


@contextmanager
def robots(url: str) -> Iterator[Executor]:
    """Processes that drive robots with clients of the service at `url`: in a single one, the models of
    several robots would wait for each other. There is one process more than there are cores, since each waits
    for the service now and then. Calls that have not begun at the end of the block are cancelled.
    """
    pool = ProcessPoolExecutor(min(cores() + 1, MOST_ROBOTS), get_context("spawn"), _begin_process, (url,))
    try:
        yield pool
    finally:
        pool.shutdown(cancel_futures=True)  # waits for the episodes that have begun


def run(
    robots: Executor,
    case: str,
    runs: int,
    seed: int,
    on_progress: Callable[[int], None] = lambda _: None,
    named: bool = False,
) -> Campaign:
    """Runs pairs of episodes of a case; `seed` and i alone determine pair i. on_progress: called with the
    number of pairs that are done.

    named: whether the sessions get ids such as `case1-0-shielded` and `case1-0-alone`, for a server without
    other sessions.
    """
    pairs = dict[int, tuple[Episode, Episode, int]]()
    for i, pair in each_done(robots.submit(_pair, case, i, seed, named) for i in range(runs)):
        pairs[i] = pair
        on_progress(len(pairs))
    shielded, unshielded, refused = zip(*(pairs[i] for i in range(runs)), strict=True)
    return Campaign(load_case(case), list(shielded), list(unshielded), sum(refused))


def each_done(futures: Iterable[Future[T]]) -> Iterator[tuple[int, T]]:
    """The number and the result of each future, in the order in which they are done.

    An interrupt (Ctrl-C) while the futures are made or waited for is raised afterwards. Raised at once, it
    could leave a lock of the pool held, for which the program would wait for ever at its end. The processes
    that the pool starts meanwhile ignore interrupts: the parent ends them.
    """
    done: SimpleQueue[Future[T] | None] = SimpleQueue()  # None: an interrupt came
    number = dict[Future[T], int]()
    with _interrupts_into(done):
        before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
        try:
            for future in futures:
                number[future] = len(number)
                future.add_done_callback(done.put)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
    while number or not done.empty():
        with _interrupts_into(done):
            found = done.get()
        if found is None:
            raise KeyboardInterrupt
        yield number.pop(found), found.result()


@contextmanager
def _interrupts_into(done: SimpleQueue[Any]) -> Iterator[None]:
    raises = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    raises = raises and threading.current_thread() is threading.main_thread()
    if raises:
        signal.signal(signal.SIGINT, lambda *_: done.put(None))
    try:
        yield
    finally:
        if raises:
            signal.signal(signal.SIGINT, signal.default_int_handler)


_client: ShieldClient | None = None  # the client of a process that drives robots
_case = cache(load_case)


def _begin_process(url: str) -> None:
    global _client
    threading.Thread(target=_end_with_parent, daemon=True).start()
    _client = ShieldClient(url, timeout=PATIENCE)


def _end_with_parent() -> None:
    if (parent := parent_process()) is not None:
        parent.join()
        os._exit(1)


def _pair(name: str, i: int, seed: int, named: bool) -> tuple[Episode, Episode, int]:
    assert _client is not None
    case, own = _case(name), int(np.random.SeedSequence([seed, i]).generate_state(1)[0])
    ids = [f"{name}-{i}-{how}" if named else None for how in ("shielded", "alone")]
    session, start, refused = begin(_client, case, name, own, id=ids[0])
    model = load_learned(case.instruction)
    shielded = with_shield(session, case, model, start, own)
    return shielded, without_shield(_client, case, model, start, own, id=ids[1]), refused


def begin(client: ShieldClient, case: Case, policy: str, seed: int, **more: Any) -> tuple[Session, Pose, int]:
    """Draws starts uniformly over free space until one is not refused. Returns its session, that start, and
    the number of refused ones. more: options of the session.
    """
    starts = free_poses(case.task, case.body, DRAWS, np.random.default_rng([seed, 2]))
    for refused, (x, y, theta) in enumerate(starts.tolist()):
        start = (x, y, theta)
        with suppress(InfeasibleStart):
            session = client.sessions.create(policy_id=policy, initial_pose=start, seed=seed, **more)
            return session, start, refused
    raise InfeasibleStart(f"none of {DRAWS} starts in {case.name} can satisfy the rule", path="initial_pose")
