"""Many episodes of a case, each start once with the shield and once without, several robots at a time."""

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
PATIENCE = 60.0  # [s] for one decision: other work may share the machine
MOST_ROBOTS = 8  # processes at once, of 190 MB each; chosen by hand
DRAWS = 100  # starts tried for one episode before giving up


class Campaign(NamedTuple):
    """Episodes in pairs: `shielded[i]` and `unshielded[i]` share their start and the model's seed.

    refused: how many starts the service refused as infeasible before it took those of the episodes.
    """

    case: Case
    shielded: list[Episode]
    unshielded: list[Episode]
    refused: int

    @property
    def broken(self) -> list[Episode]:
        """The shielded episodes that did not satisfy the rule: none, by the shield's promise."""
        return [episode for episode in self.shielded if episode.spec_status != "satisfied"]


@contextmanager
def robots(url: str) -> Iterator[Executor]:
    """Processes that drive robots, through clients of the service at `url`: the models of several robots
    would wait for each other in one. There is one more than there are cores, since each waits for the service
    now and then. What has not begun by the end of the block is called off.
    """
    pool = ProcessPoolExecutor(min(cores() + 1, MOST_ROBOTS), get_context("spawn"), _begin_process, (url,))
    try:
        yield pool
    finally:
        pool.shutdown(cancel_futures=True)  # those that drive come to their end


def run(
    robots: Executor,
    case: str,
    runs: int,
    seed: int,
    on_progress: Callable[[int], None] = lambda _: None,
    named: bool = False,
) -> Campaign:
    """`runs` pairs of episodes of a case, the i-th decided by `seed` and i alone. on_progress: how many are
    done.

    named: whether the sessions' ids say what they are, such as `case1-0-shielded` and `case1-0-alone`: for a
    server that has no others.
    """
    pairs = dict[int, tuple[Episode, Episode, int]]()
    for i, pair in each_done(robots.submit(_pair, case, i, seed, named) for i in range(runs)):
        pairs[i] = pair
        on_progress(len(pairs))
    shielded, unshielded, refused = zip(*(pairs[i] for i in range(runs)), strict=True)
    return Campaign(load_case(case), list(shielded), list(unshielded), sum(refused))


def each_done(futures: Iterable[Future[T]]) -> Iterator[tuple[int, T]]:
    """The number of each future and its result, as they come.

    An interrupt that comes while the futures are made or waited for is raised afterwards. Raised at once, it
    could leave one of the pool's locks held, and the program would wait for that for ever at its end. The
    processes that the pool starts meanwhile never see an interrupt: the parent ends them.
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


_client: ShieldClient | None = None  # of a process that drives robots
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
    """A session at the first start that is not refused, of those drawn uniformly over free space; that start;
    and how many were refused. more: options of the session.
    """
    starts = free_poses(case.task, case.body, DRAWS, np.random.default_rng([seed, 2]))
    for refused, (x, y, theta) in enumerate(starts.tolist()):
        start = (x, y, theta)
        with suppress(InfeasibleStart):
            session = client.sessions.create(policy_id=policy, initial_pose=start, seed=seed, **more)
            return session, start, refused
    raise InfeasibleStart(f"none of {DRAWS} starts in {case.name} can satisfy the rule", path="initial_pose")
