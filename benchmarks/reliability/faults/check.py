"""Whether what was acknowledged is still there: compared with what is read back, and decided again."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Any

import httpx

from benchmarks.reliability.robots import POLICY, Episode

COUNTS = ("lost", "doubled", "changed", "decided_otherwise", "violated", "stuck")


def check(url: str, reference: str, episodes: Iterable[Episode]) -> dict[str, Any]:
    """Counts over all steps that were acknowledged, and the first few that were not as they should be.

    lost: not in the trajectory. doubled: two different answers to one step, or a state too many. changed:
    other bytes in the trajectory. decided_otherwise: a server that nothing happened to, at `reference`,
    decides them otherwise. violated: episodes whose verdict is not `satisfied`. stuck: episodes without one.
    """
    found, finds = Counter(dict.fromkeys(COUNTS, 0)), list[str]()
    total = steps = 0
    for episode in episodes:
        total += 1
        if episode.verdict is None:
            found["stuck"] += 1
            finds.append(f"{episode.id}: {episode.problem}")
        elif episode.verdict != "satisfied":
            found["violated"] += 1
            finds.append(f"{episode.id}: {episode.verdict}")
        answers, doubled = acknowledged(episode)
        steps += len(answers)
        found["doubled"] += doubled
        kept = trajectory(url, episode.id) if answers else []
        found["doubled"] += max(0, len(kept) - len(answers) - 1) if episode.verdict else 0
        for t, (_, content) in answers.items():
            if t >= len(kept) or kept[t] is None:
                found["lost"] += 1
                finds.append(f"{episode.id}: step {t} lost")
            elif kept[t] != content:
                found["changed"] += 1
                finds.append(f"{episode.id}: step {t} changed")
        again = decide_again(reference, episode, answers)
        found["decided_otherwise"] += again
        if again:
            finds.append(f"{episode.id}: {again} decided otherwise")
    return {"episodes": total, "steps": steps, **found, "finds": finds[:20]}


def acknowledged(episode: Episode) -> tuple[dict[int, tuple[bytes, bytes]], int]:
    """For each step that was answered with 200: what was sent first and the answer. And how many steps were
    answered in two ways.
    """
    answers, doubled = dict[int, tuple[bytes, bytes]](), 0
    for tried in episode.exchanges:
        if tried.status == 200 and tried.path.endswith("/steps"):
            t = json.loads(tried.sent)["t"]
            first = answers.setdefault(t, (tried.sent, tried.content))
            doubled += first[1] != tried.content
    return dict(sorted(answers.items())), doubled


def trajectory(url: str, id: str) -> list[bytes | None]:
    """The answer to each step as the service gives it back, byte for byte."""
    answer = httpx.get(
        f"{url}/v1/sessions/{id}/trajectory", params={"format": "ndjson"}, timeout=60.0, trust_env=False
    )
    if answer.status_code == 404:
        return []
    answer.raise_for_status()
    kept = list[bytes | None]()
    for line in answer.content.splitlines():
        _, _, decision = line.partition(b',"decision":')
        kept.append(None if decision == b"null}" else decision[:-1])
    return kept


def decide_again(reference: str, episode: Episode, answers: Mapping[int, tuple[bytes, bytes]]) -> int:
    """How many of the steps another server decides otherwise, by a byte."""
    if not answers:
        return 0
    begun = {"policy_id": POLICY, "initial_pose": list(episode.start), "seed": episode.seed}
    otherwise = 0
    with httpx.Client(base_url=reference, timeout=60.0, trust_env=False) as http:
        created = http.post("/v1/sessions", json=begun)
        created.raise_for_status()
        path = f"/v1/sessions/{created.json()['id']}"
        for sent, content in answers.values():
            headers = {"Content-Type": "application/json"}
            otherwise += http.post(f"{path}/steps", content=sent, headers=headers).content != content
        http.delete(path)
    return otherwise
