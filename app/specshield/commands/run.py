"""`specshield run`: drives a simulated robot with a policy, and draws its way."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from specshield.errors import InputError, NotFound

if TYPE_CHECKING:  # every command imports this module
    from specshield.sim.cases import Case


def run_policy(
    policy: Annotated[str, typer.Argument(help="Id or name of a policy in SPECSHIELD_DATA_DIR.")],
    target: Annotated[str | None, typer.Option(help="The model's target, as 2.5,1.0 in metres.")] = None,
    seed: Annotated[int, typer.Option(help="Seed of the start, the target and the model.", min=0)] = 0,
    shaping: Annotated[str, typer.Option(help="A session's shaping: projection, lookahead.")] = "projection",
    out: Annotated[Path, typer.Option(help="Folder for the picture.")] = Path("out"),
) -> None:
    """Drive a simulated robot through an episode, with and without the shield, and draw both.

    The exit status is 0 if the shielded robot kept the rule, 1 if not, 2 after an error.
    """
    from specshield.commands.serving import client_of
    from specshield.lookahead.preferences import check_shaping
    from specshield.service.settings import read_settings
    from specshield.sim import picture
    from specshield.sim.campaign import begin
    from specshield.sim.episodes import with_shield, without_shield
    from specshield.sim.model import GoalSeeker
    from specshield.sim.progress import StatusLine

    out.mkdir(parents=True, exist_ok=True)
    check_shaping(shaping)  # what is wrong is refused before a server is started
    place = None if target is None else _target(target)
    status = StatusLine()
    with client_of(None, status) as client:
        try:
            found = client.policies.get(policy)
        except NotFound as error:
            names = ", ".join(each.name for each in client.policies.list() if each.name)
            folder = read_settings().data_dir.absolute()
            error.expected = f"one of {names}, or the id of another policy in SPECSHIELD_DATA_DIR, {folder}"
            raise
        case = _case(found.id, found.name or found.id[:12], place, seed)
        session, start, refused = begin(client, case, found.id, seed, shaping=shaping)
        status.say("driving ...")
        model = GoalSeeker(case.task.robot)
        shielded = with_shield(session, case, model, start, seed)
        beside = without_shield(client, case, model, start, seed, found.id)
    status.clear()
    path = out / f"{case.name}-run.svg"
    picture.draw(case, shielded, beside, path)
    print(f"rule     {case.task.formula}")
    print(f"start    {_point(start)}, target {_point(case.target)}; {refused} starts could not keep the rule")
    for title, episode in (("shielded", shielded), ("without", beside)):
        ended = "never" if episode.ended_at is None else f"at step {episode.ended_at}"
        print(f"{title:8} rule {episode.spec_status}, main task ended {ended}, {len(episode.poses)} states")
    print(f"picture  {path}")
    raise typer.Exit(0 if shielded.spec_status == "satisfied" else 1)


def _case(id: str, name: str, target: tuple[float, float] | None, seed: int) -> Case:
    """The simulation's case for a policy in the data folder. target [m]: by default a random place that
    `seed` decides.
    """
    import numpy as np

    from specshield.policy.dqn.environment import free_poses
    from specshield.robot.dynamics import make_body
    from specshield.service.library.maps import Maps
    from specshield.service.library.policies import Policies
    from specshield.service.settings import read_settings
    from specshield.sim.cases import Case

    settings = read_settings()
    maps = Maps(settings)
    policies = Policies(settings, maps)
    about = policies.record(id).about
    task = policies.task(about)
    body, random = make_body(task.robot, task.grid), np.random.default_rng([seed, 1])
    x, y = target or free_poses(task, body, 1, random)[0, :2].tolist()
    case = Case(name, task, maps.get(about.map_id).rooms, about.spec, f"go to {_point((x, y))}", (x, y))
    if target is not None and (not task.grid.holds((x, y)) or task.grid.occupied[case.cell((x, y))]):
        told = f"{x:g},{y:g}"
        raise InputError("no robot can stand there", path="--target", got=told, expected="a free place")
    return case


def _target(text: str) -> tuple[float, float]:
    try:
        x, y = json.loads(f"[{text}]")
        return float(x), float(y)
    except (ValueError, TypeError):
        raise InputError("not a place", path="--target", got=text, expected="x,y in metres") from None


def _point(values: Sequence[float]) -> str:
    return f"({', '.join(f'{value:.2f}' for value in values)})"
