"""What `specshield demo` and `evaluate` do. Each returns the command's exit status."""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

from specshield.client import ShieldClient
from specshield.sim import picture, report
from specshield.sim.campaign import Campaign, run
from specshield.sim.cases import Case, case_names, load_case
from specshield.sim.progress import StatusLine, duration
from specshield.sim.service import own_server

PATIENCE = 10.0  # [s] for one decision: other work may share the machine


def demo(runs: int, seed: int, out: Path) -> int:
    """Every case, with and without the shield: a table, and a picture of each case in `out`.

    1 if an episode with the shield broke its rule.
    """
    began, status = time.monotonic(), StatusLine()
    status.say("starting the service (its first start compiles: about a minute) ...")
    with own_server() as url, ShieldClient(url, timeout=PATIENCE) as client:
        campaigns = [_campaign(client, load_case(name), runs, seed, status) for name in case_names()]
    for campaign in campaigns:
        picture.draw(
            campaign.case, campaign.shielded[0], campaign.unshielded[0], out / f"{campaign.case.name}.png"
        )
    status.clear()
    print(f"{runs} episodes a case, seed {seed}, over HTTP\n")
    for campaign in campaigns:
        print(
            f'{campaign.case.name}  {campaign.case.task.formula}\n       model: "{campaign.case.instruction}"'
        )
    print(f"\n{report.table([report.summary(campaign) for campaign in campaigns])}\n")
    for campaign in campaigns:
        print(f"picture: {out / campaign.case.name}.png")
    print(f"{time.monotonic() - began:.0f} s")
    return _exit_status(campaigns)


def evaluate(case: str, runs: int, seed: int, as_json: bool) -> int:
    """One case with any number of runs; the table, or with `as_json` the figures and every episode."""
    status, loaded = StatusLine(), load_case(case)
    with own_server() as url, ShieldClient(url, timeout=PATIENCE) as client:
        campaign = _campaign(client, loaded, runs, seed, status)
    status.clear()
    figures = report.summary(campaign)
    if as_json:
        episodes = [episode.to_json() for episode in (*campaign.shielded, *campaign.unshielded)]
        print(json.dumps({**figures, "episodes": episodes}))
    else:
        print(report.table([figures]))
    return _exit_status([campaign])


def _campaign(client: ShieldClient, case: Case, runs: int, seed: int, status: StatusLine) -> Campaign:
    began = time.monotonic()

    def show(done: int) -> None:
        left = (time.monotonic() - began) / done * (runs - done)
        status.say(f"{case.name}: {done} of {runs} episodes, {duration(left)} left")

    return run(client, case, runs, seed, show)


def _exit_status(campaigns: list[Campaign]) -> int:
    broken = [
        episode
        for campaign in campaigns
        for episode in campaign.shielded
        if episode.spec_status != "satisfied"
    ]
    for episode in broken:
        print(
            f"BROKEN: {episode.case} from {episode.start}, seed {episode.seed}: {episode.spec_status}",
            file=sys.stderr,
        )
    return 1 if broken else 0
