"""`specshield run`: a simulated episode with a policy of one's own, drawn."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from specshield.client import ShieldClient
from specshield.commands.serving import client_of
from specshield.errors import InfeasibleStart, InputError
from specshield.policy.dqn.environment import free_poses
from specshield.sim import picture
from specshield.sim.cases import Case
from specshield.sim.episodes import with_shield, without_shield
from specshield.sim.model import GoalSeeker
from specshield.sim.progress import StatusLine

DRAWS = 100  # starts that are tried


def run(policy: str, target: str | None, seed: int, out: Path) -> int:
    """One episode with the shield and one without, from one start. Returns 1 where the shield broke its rule.

    target: "x,y" [m]; without it a place drawn by `seed`.
    """
    status = StatusLine()
    with client_of(None, status) as client:
        found = client.policies.get(policy)
        case = _case(found.id, found.name or found.id[:12], target, seed)
        start, refused = _start(client, case, found.id, seed)
        status.say("driving ...")
        model = GoalSeeker(case.task.robot)
        session = client.sessions.create(policy_id=found.id, initial_pose=start, seed=seed)
        shielded = with_shield(session, case, model, start, seed)
        beside = without_shield(client, case, model, start, seed, found.id)
    status.clear()
    path = out / f"{case.name}-run.png"
    picture.draw(case, shielded, beside, path)
    print(f"rule     {case.task.formula}")
    print(f"start    {_point(start)}, target {_point(case.target)}; {refused} starts could not keep the rule")
    for title, episode in (("shielded", shielded), ("without", beside)):
        ended = "never" if episode.ended_at is None else f"at step {episode.ended_at}"
        print(f"{title:8} rule {episode.spec_status}, main task ended {ended}, {len(episode.poses)} states")
    print(f"picture  {path}")
    return 0 if shielded.spec_status == "satisfied" else 1


def _case(id: str, name: str, target: str | None, seed: int) -> Case:
    """The policy's task as the simulation takes it, from the data folder."""
    from specshield.service.library.maps import Maps
    from specshield.service.library.policies import Policies
    from specshield.service.settings import read_settings

    settings = read_settings()
    maps = Maps(settings)
    policies = Policies(settings, maps)
    about = policies.record(id).about
    task = policies.task(about)
    place = _drawn(task, seed) if target is None else _target(target)
    return Case(name, task, maps.get(about.map_id).rooms, about.spec, f"go to {_point(place)}", place)


def _drawn(task: object, seed: int) -> tuple[float, float]:
    from specshield.robot.dynamics import make_body
    from specshield.task import Task

    assert isinstance(task, Task)
    body = make_body(task.robot, task.grid)
    x, y, _ = free_poses(task, body, 1, np.random.default_rng([seed, 1]))[0].tolist()
    return x, y


def _target(text: str) -> tuple[float, float]:
    try:
        x, y = json.loads(f"[{text}]")
        return float(x), float(y)
    except (ValueError, TypeError):
        raise InputError("not a place", path="--target", got=text, expected="x,y in metres") from None


def _start(client: ShieldClient, case: Case, id: str, seed: int) -> tuple[tuple[float, float, float], int]:
    """The first of the drawn starts from which the rule can be kept, and how many could not."""
    starts = free_poses(case.task, case.body, DRAWS, np.random.default_rng([seed, 2]))
    for refused, (x, y, theta) in enumerate(starts.tolist()):
        try:
            client.sessions.create(policy_id=id, initial_pose=(x, y, theta)).close()
        except InfeasibleStart:
            continue
        return (x, y, theta), refused
    raise InfeasibleStart(f"none of {DRAWS} starts can keep the rule", path="initial_pose")


def _point(values: Sequence[float]) -> str:
    return f"({', '.join(f'{value:.2f}' for value in values)})"
