"""Rows in which several callers ask for one thing at once."""

from __future__ import annotations

import json
import threading
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

import httpx

from benchmarks.reliability.faults.check import trajectory
from benchmarks.reliability.faults.kills import Scene
from benchmarks.reliability.plant import RedisServer, Service
from benchmarks.reliability.robots import POLICY, logits_of

AT_ONCE = 20
RACE = 60  # steps of a race at most


def at_once(calls: Sequence[Callable[[], httpx.Response]]) -> list[httpx.Response]:
    """The answers; all calls are sent at the same moment, each on a connection of its own."""
    gate, answers = threading.Barrier(len(calls)), list[Any]([None] * len(calls))

    def one(i: int) -> None:
        gate.wait(30.0)
        answers[i] = calls[i]()

    threads = [threading.Thread(target=one, args=(i,)) for i in range(len(calls))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(120.0)
    if None in answers:
        raise TimeoutError("a caller had no answer")
    return answers


def _callers(urls: Sequence[str], n: int) -> list[httpx.Client]:
    """Connected already, so that their first requests meet."""
    made = [httpx.Client(base_url=urls[i % len(urls)], timeout=60.0, trust_env=False) for i in range(n)]
    for each in made:
        each.get("/livez")
    return made


def _begin(url: str, start: Sequence[float], seed: int) -> dict[str, Any]:
    asked = {"policy_id": POLICY, "initial_pose": list(start), "seed": seed}
    answer = httpx.post(f"{url}/v1/sessions", json=asked, timeout=60.0, trust_env=False)
    answer.raise_for_status()
    session: dict[str, Any] = answer.json()
    return session


def _race(
    callers: list[httpx.Client], id: str, t: int, pose: Sequence[float], seeds: Sequence[int]
) -> tuple[bytes | None, bool]:
    """Step t asked for by all callers at once, each with the logits of its seed. The winning answer, and
    whether it is as promised: equal requests have equal bytes, and of different ones exactly one is answered.
    """
    bodies = [{"t": t, "poses": [list(pose)], "logits": logits_of(seed, t)} for seed in seeds]
    path = f"/v1/sessions/{id}/steps"
    calls = [lambda c=c, b=b: c.post(path, json=b) for c, b in zip(callers, bodies, strict=True)]
    answers = at_once(calls)
    won = {(seeds[i], answer.content) for i, answer in enumerate(answers) if answer.status_code == 200}
    others = [answer for answer in answers if answer.status_code != 200]
    refused = all(a.status_code == 409 and a.json()["type"] == "step-conflict" for a in others)
    if len(won) != 1 or not refused:
        return None, False
    ((winner, content),) = won
    same = sum(seed == winner for seed in seeds)
    return content, sum(answer.status_code == 200 for answer in answers) == same


def replicas(scene: Scene) -> dict[str, Any]:
    """Two servers on one redis-server, four callers who race for each step of an episode: at even steps with
    equal requests, at odd ones with four different ones.
    """
    wrong = changed = steps = 0
    with (
        RedisServer(scene.folder / "redis") as store,
        Service(scene.folder / "data", REDIS_URL=store.url) as one,
        Service(scene.folder / "data", REDIS_URL=store.url) as two,
    ):
        callers = _callers([one.url, two.url], 4)
        for i in range(max(1, scene.n // 10)):
            start = scene.starts[i % len(scene.starts)]
            id, pose, answers = _begin(one.url, start, i)["id"], start, list[bytes]()
            for t in range(RACE):
                seeds = [i] * 4 if t % 2 == 0 else [4 * i + k for k in range(4)]
                content, fine = _race(callers, id, t, pose, seeds)
                wrong += not fine
                if content is None:
                    break
                answers.append(content)
                decision = json.loads(content)
                pose = decision["next_poses"][decision["action"]]
                if decision["spec_status"] != "pending":
                    break
            steps += len(answers)
            for url in (one.url, two.url):
                changed += trajectory(url, id)[: len(answers)] != answers
    return {"races": steps, "steps": steps, "not_one_winner": wrong, "changed": changed}


def same_step(scene: Scene) -> dict[str, Any]:
    """The same step 20 times at once: 20 answers of the same bytes."""
    return _rounds(scene, lambda i: [i] * AT_ONCE)


def different_steps(scene: Scene) -> dict[str, Any]:
    """20 different requests for one step at once: one is answered, 19 are 409 `step-conflict`."""
    return _rounds(scene, lambda i: [AT_ONCE * i + k for k in range(AT_ONCE)])


def _rounds(scene: Scene, seeds: Callable[[int], list[int]]) -> dict[str, Any]:
    wrong = changed = 0
    with Service(scene.folder / "data") as service:
        callers = _callers([service.url], AT_ONCE)
        for i in range(scene.n):
            start = scene.starts[i % len(scene.starts)]
            id = _begin(service.url, start, i)["id"]
            content, fine = _race(callers, id, 0, start, seeds(i))
            wrong += not fine
            changed += trajectory(service.url, id)[:1] != [content]
    return {"races": scene.n, "steps": scene.n, "not_one_winner": wrong, "changed": changed}


def creates(scene: Scene) -> dict[str, Any]:
    """20 sessions of one id at once: one is made, 19 are 409 `session-exists`."""
    wrong, seen = 0, Counter[int]()
    with Service(scene.folder / "data") as service:
        callers = _callers([service.url], AT_ONCE)
        for i in range(scene.n):
            asked = {"id": f"race-{i}", "policy_id": POLICY, "initial_pose": scene.starts[0]}
            calls = [
                lambda c=c, k=k, a=asked: c.post("/v1/sessions", json={**a, "seed": k})
                for k, c in enumerate(callers)
            ]
            answers = at_once(calls)
            seen.update(answer.status_code for answer in answers)
            made = [answer.json() for answer in answers if answer.status_code == 201]
            kept = callers[0].get(f"/v1/sessions/race-{i}").json()
            others = [answer for answer in answers if answer.status_code != 201]
            refused = all(a.status_code == 409 and a.json()["type"] == "session-exists" for a in others)
            wrong += len(made) != 1 or not refused or made[0]["seed"] != kept["seed"]
    statuses = {str(status): count for status, count in sorted(seen.items())}
    return {"races": scene.n, "not_one_winner": wrong, "tries_by_status": statuses}
