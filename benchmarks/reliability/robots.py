"""Robots that go through episodes and keep every answer: by the SDK, or by httpx with retries of their own.

Their models are saboteurs: logits drawn at random, some of them null, without a thought of the rule. They go
where the service says that the action leads (`next_poses`), so that they need no map.
"""

from __future__ import annotations

import json
import random
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, TypeVar

import httpx

from specshield.client import Session, ShieldClient
from specshield.client.network.bounded import Transport
from specshield.errors import (
    Busy,
    InputError,
    InsufficientStorage,
    ServerError,
    SessionExists,
    Starting,
    StoreError,
    TransportError,
)

T = TypeVar("T")
POLICY = "case1"
PATIENCE = 180.0  # [s] without an answer after which a robot counts as stuck
NAPS = 40  # steps between two naps, on average
PAUSE = 0.05  # [s] between two tries of the plain robot
TIMEOUT = 3.0  # [s] of one try; more than the 2 s that a server waits for its store
PASSING = (429, 502, 503, 504, 507)  # answers that say: ask again
ACTIONS, END = 20, 4  # of the Stretch; the index of the action that ends the model's task
AWAY = (TransportError, StoreError, Starting, Busy, InsufficientStorage)


@dataclass(frozen=True)
class Exchange:
    """One try. status 0: no answer came. began, ended: time.monotonic() [s]."""

    path: str
    sent: bytes
    status: int
    content: bytes
    began: float
    ended: float


class Recording(httpx.BaseTransport):
    """The SDK's own transport, with a note of all that goes through it."""

    def __init__(self, url: str, kept: list[Exchange]) -> None:
        self._inner, self._kept = Transport(httpx.URL(url)), kept

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        began, status, content = time.monotonic(), 0, b""
        sent = request.read()
        try:
            response = self._inner.handle_request(request)
            try:
                content = b"".join(response.stream)  # type: ignore[arg-type]
            finally:
                response.close()
            status = response.status_code
        finally:
            ended = time.monotonic()
            self._kept.append(Exchange(request.url.path, sent, status, content, began, ended))
        return httpx.Response(status, headers=response.headers, content=content)

    def close(self) -> None:
        self._inner.close()


@dataclass
class Episode:
    """One session from its beginning to its verdict; steps: how many were answered."""

    id: str
    seed: int
    start: Sequence[float]
    steps: int = 0
    verdict: str | None = None
    problem: str | None = None
    exchanges: list[Exchange] = field(default_factory=list)


class Robot(threading.Thread):
    """Goes through episodes until `over` is set, and then to the end of the one it is in.

    sdk: by the SDK, else by plain httpx. nap: now and then, one step in NAPS, it stands still so long [s].
    """

    def __init__(
        self,
        name: str,
        urls: Sequence[str],
        starts: Sequence[Sequence[float]],
        seed: int,
        over: threading.Event,
        sdk: bool,
        nap: float = 0.0,
    ) -> None:
        super().__init__(name=name, daemon=True)
        self.urls, self.over, self.sdk, self.nap = urls, over, sdk, nap
        self._starts, self._seed = starts, seed
        self.episodes: list[Episode] = []
        self.tries: list[Exchange] = []

    def run(self) -> None:
        number = 0
        while not self.over.is_set():
            seed = 1000 * self._seed + number
            start = self._starts[seed % len(self._starts)]
            episode = Episode(f"{self.name}-{number}", seed, start)
            self.episodes.append(episode)
            first = len(self.tries)
            try:
                (self._by_sdk if self.sdk else self._by_hand)(episode)
            except Exception as error:
                episode.problem = f"{type(error).__name__}: {error}"[:500]
                return
            finally:
                episode.exchanges = self.tries[first:]
            number += 1

    def _by_sdk(self, episode: Episode) -> None:
        url = self.urls[episode.seed % len(self.urls)]
        client = ShieldClient(url, timeout=TIMEOUT, transport=Recording(url, self.tries))
        try:
            session = _persist(lambda: _begin(client, episode))
            pose = tuple(episode.start)
            while session.spec_status == "pending":
                logits = logits_of(episode.seed, session.t)
                decision = _persist(lambda at=pose, by=logits: session.step(at, by))
                pose = decision.next_poses[decision.execute]
                episode.steps += 1
                self._rest(episode.seed, session.t)
            episode.verdict = _persist(lambda: session.close(pose)).spec_status
        finally:
            client.close()

    def _by_hand(self, episode: Episode) -> None:
        with httpx.Client(timeout=TIMEOUT, trust_env=False) as http:
            begun = {"id": episode.id, "policy_id": POLICY, "initial_pose": list(episode.start)}
            self._post(http, "/v1/sessions", {**begun, "seed": episode.seed}, taken=409)
            path, pose, t, status = f"/v1/sessions/{episode.id}", list(episode.start), 0, "pending"
            while status == "pending":
                body = {"t": t, "poses": [pose], "logits": logits_of(episode.seed, t)}
                answer = self._post(http, f"{path}/steps", body)
                pose, status = answer["next_poses"][answer["action"]], answer["spec_status"]
                t = episode.steps = t + 1
                self._rest(episode.seed, t)
            closed = self._post(http, f"{path}/close", {"t": t, "poses": [pose]})
            episode.verdict = closed["spec_status"]

    def _rest(self, seed: int, t: int) -> None:
        if self.nap and random.Random(31 * seed + t).random() < 1 / NAPS:
            time.sleep(self.nap)

    def _post(self, http: httpx.Client, path: str, body: Any, taken: int = 0) -> Any:
        """Sent again, byte for byte and to each server in turn, until there is an answer worth having.

        taken: a status that is as good after a try whose answer was lost.
        """
        sent, lost, ends = json.dumps(body).encode(), False, time.monotonic() + PATIENCE
        while time.monotonic() < ends:
            url = self.urls[len(self.tries) % len(self.urls)]
            began, status, content = time.monotonic(), 0, b""
            try:
                answer = http.post(url + path, content=sent, headers={"Content-Type": "application/json"})
                status, content = answer.status_code, answer.content
            except httpx.TransportError:
                lost = True
            self.tries.append(Exchange(path, sent, status, content, began, time.monotonic()))
            if status in (200, 201) or (lost and status == taken != 0):
                return json.loads(content)
            lost = lost or status in PASSING  # the store may have written what it did not answer in time
            if status not in (0, *PASSING):
                raise ServerError(f"{path}: {status} {content[:300]!r}")
            time.sleep(PAUSE)
        raise TimeoutError(f"{path}: no answer in {PATIENCE} s")


def _begin(client: ShieldClient, episode: Episode) -> Session:
    """A session, or the one that a call before has begun without hearing of it: ids are never used again."""
    try:
        return client.sessions.create(
            policy_id=POLICY, initial_pose=tuple(episode.start), seed=episode.seed, id=episode.id
        )
    except SessionExists:
        return client.sessions.get(episode.id)


def _persist(call: Callable[[], T]) -> T:
    """The SDK gives up after some time; a robot then asks again."""
    ends = time.monotonic() + PATIENCE
    while time.monotonic() < ends:
        with suppress(*AWAY):
            return call()
    return call()


def logits_of(seed: int, t: int) -> list[float | None]:
    """Of the model at step t: any preference, now and then for one action alone. The same each time."""
    drawn = random.Random(1_000_003 * seed + t)
    values: list[float | None] = [drawn.gauss(0.0, 3.0) for _ in range(ACTIONS)]
    if drawn.random() < 0.2:
        for i in drawn.sample(range(ACTIONS), 12):
            values[i] = None
    values[END] = None
    if all(value is None for value in values):
        values[0] = 0.0
    return values


def find_starts(url: str, n: int, seed: int = 0) -> list[list[float]]:
    """n poses of the case's map from where its rule can be kept."""
    drawn, found = random.Random(seed), list[list[float]]()
    with ShieldClient(url, timeout=10.0) as client:
        xmin, ymin, xmax, ymax = client.maps.get(POLICY).bounds
        while len(found) < n:
            pose = [drawn.uniform(xmin, xmax), drawn.uniform(ymin, ymax), drawn.uniform(-3.1, 3.1)]
            try:
                session = client.sessions.create(policy_id=POLICY, initial_pose=tuple(pose))
            except InputError:
                continue
            client.sessions.delete(session.id)
            found.append(pose)
    return found
