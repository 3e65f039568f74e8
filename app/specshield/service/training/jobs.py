"""The runs that make policies: queued with rq, with their state in `specshield:training:{id}`.

A run writes its state only while its `attempt`, the name of its job, is the latest one, so that cancelling
and asking again are one write each. A run counts as failed if it gives no more signs of life, or if it has
left the queue and never gave one.

In a queue the owners of API keys take turns: an attempt begins with a mark of its owner. A run that several
owners ask for belongs to the one whose turn for it comes first.
"""

from __future__ import annotations

import hashlib
import secrets
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from rq import Queue
from rq.job import Job
from rq.serializers import JSONSerializer

from specshield.errors import StoreError
from specshield.policy.methods import METHODS
from specshield.service.library.claims import reached
from specshield.service.settings import Settings
from specshield.service.storage.connect import connect, reaching
from specshield.service.watch import logs

ENDED = "specshield:jobs:ended"  # a hash from "method state" to the number of runs
AGAIN = "ask for it again: a method that learns goes on from its last checkpoint"
SIGN_OF_LIFE = 5  # [s] without a sign of life after which a run, or the last worker, counts as dead
OWNER = 16  # letters of an attempt that are its owner's mark
MOVE = """
if redis.call('LREM', KEYS[1], -1, ARGV[1]) == 1
    and redis.call('LINSERT', KEYS[1], 'BEFORE', ARGV[2], ARGV[1]) < 1 then
    redis.call('LPUSH', KEYS[1], ARGV[1])
end"""
WRITE = """
local attempt, status, method = unpack(redis.call('HMGET', KEYS[1], 'attempt', 'status', 'method'))
if attempt ~= ARGV[1] or status == 'ready' or status == 'failed' then return '' end
redis.call('HSET', KEYS[1], unpack(ARGV, 2))
return method
"""


@dataclass(frozen=True)
class Training:
    """The state of a run. eta_s: estimate of the time left [s]. error: why it failed, or why it waits."""

    status: str  # queued, training, ready or failed
    progress: float = 0.0
    eta_s: float | None = None
    error: str | None = None


class Jobs:
    """Every method raises StoreError if the store cannot be reached in time."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings

    @cached_property
    def redis(self) -> Any:
        """The store's client, opened at the first use, since a cluster may be away and is asked at once."""
        return connect(self._settings.store_url, blocking=True, socket_timeout=self._settings.store_timeout)

    def worker_there(self, method: str) -> bool:
        return bool(reached(lambda: self.redis.exists(_worker(method))))

    def start(self, id: str, method: str, owner: str) -> None:
        """Queues a run for this policy, which an owner has asked for."""
        attempt = _mark(owner) + secrets.token_hex(8)
        state = {"attempt": attempt, "status": "queued", "progress": 0, "eta_s": "", "error": ""}
        self.sign_of_life(id, attempt)  # for the moment in which the state is written and the queue is not
        with reaching():
            self.redis.hset(_key(id), mapping={**state, "method": method})
            self._enqueue(id, attempt, method)
            self._move(attempt, self._turn(_mark(owner), method, attempt), method)
        logs.tell("policy queued", policy_id=id, method=method)

    def ask_too(self, id: str, method: str, owner: str) -> None:
        """Makes a waiting run that of another owner who asks for the policy, if its turn comes sooner so."""
        attempt = (reached(lambda: self.redis.hget(_key(id), "attempt")) or b"").decode()
        queue, own = self._queue(method), _mark(owner)
        with reaching():
            before = self._turn(own, method, attempt)
            if before is None or own == attempt[:OWNER]:
                return
            self.sign_of_life(id, attempt)  # for the moment in which the queue does not have it
            if self.redis.lrem(queue.key, 1, attempt):  # else a worker has taken it
                self.redis.delete(Job.key_for(attempt))
                again = own + secrets.token_hex(8)
                if self.report(id, attempt, attempt=again):  # else it was cancelled
                    self._enqueue(id, again, method)
                    self._move(again, before, method)

    def _enqueue(self, id: str, attempt: str, method: str, at_front: bool = False) -> None:
        settings = self._settings
        self._queue(method).enqueue(
            "specshield.service.training.worker.train",
            id,
            attempt,
            job_id=attempt,
            job_timeout=settings.training_timeout if learns(method) else settings.synthesis_timeout,
            result_ttl=0,
            failure_ttl=24 * 3600,
            at_front=at_front,
        )

    def _turn(self, own: str, method: str, attempt: str) -> str | None:
        """The waiting run before which this attempt would stand if it were that of the owner with the mark
        `own`: the first one whose owner has more runs before it, running or waiting, than this owner has.
        None if no such run stands before it now.
        """
        queue = self._queue(method)
        running = self.redis.zrange(queue.started_job_registry.key, 0, -1)
        waiting: list[str] = [each.decode() for each in self.redis.lrange(queue.key, 0, -1)]
        before = Counter(each.decode()[:OWNER] for each in running)
        most = before[own] + sum(each[:OWNER] == own for each in waiting if each != attempt)
        for other in waiting:
            if other == attempt:
                return None
            if before[other[:OWNER]] > most:
                return other
            before[other[:OWNER]] += 1
        return None

    def _move(self, attempt: str, before: str | None, method: str) -> None:
        """Moves a run from the end of the queue to before another one."""
        if before is not None:
            self.redis.eval(MOVE, 1, self._queue(method).key, attempt, before)

    def _queue(self, method: str) -> Queue:
        return Queue(queue_of(method), connection=self.redis, serializer=JSONSerializer)

    def get(self, id: str) -> Training:
        """The state of a policy's latest run. A policy without one in the store counts as failed."""
        found, alive = reached(lambda: (self.redis.hgetall(_key(id)), self.redis.exists(_alive(id))))
        state = {name.decode(): value.decode() for name, value in found.items()}
        status, error = state.get("status", "failed"), state.get("error") or None
        if status == "failed" and not state:
            error = "the store no longer knows how far it was made; ask for it again"
        if status == "queued" and not alive and not self._waits(state["method"], state["attempt"]):
            self.sign_of_life(id, state["attempt"])  # a worker has it; if that has died, this ends soon
            self.report(id, state["attempt"], status="training")
            status = "training"
        elif status == "training" and not alive:
            status, error = "failed", f"its worker is gone; {AGAIN}"
        if status == "queued" and not self.worker_there(state["method"]):
            error = "it waits for a worker that makes policies by this method: none is running"
        eta = state.get("eta_s")
        return Training(status, float(state.get("progress", 0.0)), float(eta) if eta else None, error)

    def _waits(self, method: str, attempt: str) -> bool:
        return reached(lambda: self.redis.lpos(self._queue(method).key, attempt)) is not None

    def cancel(self, id: str) -> None:
        """Cancels a run. One that has begun ends within about a second, a queued one when it begins."""
        fields = {"attempt": "", "status": "failed", "error": "cancelled", "eta_s": ""}
        reached(lambda: self.redis.hset(_key(id), mapping=fields))
        logs.tell("policy cancelled", policy_id=id)

    def forget(self, id: str) -> None:
        reached(lambda: self.redis.unlink(_key(id)))

    def counts(self) -> tuple[dict[tuple[str, str], int], dict[tuple[str, str], int]]:
        """The numbers of runs by method and state: those queued or training now, and those that ended."""
        methods = METHODS.names()
        with reaching(), self.redis.pipeline(transaction=False) as pipe:
            for name in methods:
                queue = self._queue(name)
                pipe.llen(queue.key)
                pipe.zcard(queue.started_job_registry.key)
            pipe.hgetall(ENDED)
            *now, ended = pipe.execute()
        live = [(name, state) for name in methods for state in ("queued", "training")]
        told = {tuple(key.decode().split(" ", 1)): int(count) for key, count in ended.items()}
        return dict(zip(live, now, strict=True)), told

    def hand_back(self, id: str, attempt: str) -> None:
        """Puts a run whose worker stops at the front of the queue, unless another attempt has replaced it."""
        again = attempt[:OWNER] + secrets.token_hex(8)
        if method := self.report(id, attempt, attempt=again, status="queued", eta_s=""):
            reached(lambda: self._enqueue(id, again, method, at_front=True))

    def end(self, id: str, attempt: str, error: str | None) -> None:
        """Notes that a run made its policy, or the error why it did not. A cancelled run notes nothing."""
        told: dict[str, Any] = {} if error is None else {"error": error}
        state, said = ("ready", "policy made") if error is None else ("failed", "policy not made")
        if method := self.report(id, attempt, status=state, eta_s="", **(told or {"progress": 1})):
            with suppress(StoreError):  # losing this count is no reason to fail
                reached(lambda: self.redis.hincrby(ENDED, f"{method} {state}", 1))
            logs.tell(said, policy_id=id, method=method, **told)

    # --- for the run itself

    def report(self, id: str, attempt: str, /, **fields: Any) -> str:
        """Writes fields of the run's state and returns its method. For a cancelled run, only returns ""."""
        pairs = [part for pair in fields.items() for part in pair]
        method: bytes = reached(lambda: self.redis.eval(WRITE, 1, _key(id), attempt, *pairs))
        return method.decode()

    def sign_of_life(self, id: str, attempt: str) -> bool:
        """Notes that the run is alive. False once it was cancelled or asked for again."""
        reached(lambda: self.redis.set(_alive(id), 1, ex=SIGN_OF_LIFE))
        return bool(reached(lambda: self.redis.hget(_key(id), "attempt")) == attempt.encode())

    def worker_lives(self, methods: Sequence[str]) -> None:
        """Notes that a worker for these methods is alive."""
        with reaching():
            for method in methods:
                self.redis.set(_worker(method), 1, ex=SIGN_OF_LIFE)


def learns(method: str) -> bool:
    """Whether the method learns, which may take hours: these are the methods that need additional modules."""
    return bool(METHODS.get(method).needs)


def _mark(owner: str) -> str:
    return hashlib.sha256(owner.encode()).hexdigest()[:OWNER]


def queue_of(method: str) -> str:
    """The name of rq's queue for a method. Each has its own, since not every worker has all methods."""
    return f"specshield-{method}"


def _worker(method: str) -> str:
    return f"specshield:worker:{method}"


def _key(id: str) -> str:
    return f"specshield:training:{{{id}}}"


def _alive(id: str) -> str:
    return f"specshield:training:{{{id}}}:alive"
