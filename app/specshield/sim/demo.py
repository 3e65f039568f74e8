"""`specshield demo`: runs both cases over HTTP, prints a table of results, and draws a picture of each."""

from __future__ import annotations

import contextlib
import signal
import sys
import time
from collections.abc import Sequence
from concurrent.futures import Executor, Future
from pathlib import Path

from specshield.sim import picture, report
from specshield.sim.campaign import Campaign, robots, run
from specshield.sim.cases import case_names, load_case
from specshield.sim.progress import StatusLine, duration
from specshield.sim.service import own_server


def run_demo(runs: int, seed: int, out: Path, stay: bool = False) -> int:
    """Runs every case with and without the shield, and writes the pictures into the folder `out`.

    stay: whether the service and its page stay up until an interrupt (Ctrl-C). Returns the exit status: 1 if
    an episode with the shield broke its rule.
    """
    began, status = time.monotonic(), StatusLine()
    out.mkdir(parents=True, exist_ok=True)
    status.say("starting the service ...")
    with own_server(say=status.say, complete=stay) as url:
        with robots(url) as several:
            campaigns, pictures = list[Campaign](), list[Future[None]]()
            for name in case_names():
                campaigns.append(_campaign(several, name, runs, seed, status))
                first = campaigns[-1].shielded[0], campaigns[-1].unshielded[0]
                # One of the processes draws while the others go on with the next case.
                pictures.append(several.submit(picture.draw, load_case(name), *first, out / f"{name}.svg"))
            for drawn in pictures:
                drawn.result()
        status.clear()
        _tell(campaigns, runs, seed, out)
        print(f"{time.monotonic() - began:.0f} s")
        if stay:
            for campaign in campaigns:
                both = f"{campaign.shielded[0].session},{campaign.unshielded[0].session}"
                print(f"page of both: {url}/#/floor?sessions={both}")  # the first episode of the case, twice
            print("The service stays up for it; Ctrl-C ends both.", flush=True)
            with contextlib.suppress(KeyboardInterrupt):
                signal.pause()
        else:
            print("The service has ended with the demo. To see the page: specshield demo --open")
            print("(in a clone: make demo ARGS=--open)")
    broken = [episode for campaign in campaigns for episode in campaign.broken]
    for episode in broken:
        where = f"{episode.case} from {episode.start}, seed {episode.seed}"
        print(f"BROKEN: {where}: {episode.spec_status}", file=sys.stderr)
    return 1 if broken else 0


def _tell(campaigns: Sequence[Campaign], runs: int, seed: int, out: Path) -> None:
    print(f"{runs} episodes a case, seed {seed}, over HTTP\n")
    for case in (campaign.case for campaign in campaigns):
        print(f'{case.name}  {case.task.formula}\n       model: "{case.instruction}"')
    print(f"\n{report.table(campaigns)}\n")
    print("\n".join(f"picture: {out / campaign.case.name}.svg" for campaign in campaigns))


def _campaign(several: Executor, case: str, runs: int, seed: int, status: StatusLine) -> Campaign:
    began = time.monotonic()

    def show(done: int) -> None:
        left = (time.monotonic() - began) / done * (runs - done)
        status.say(f"{case}: {done} of {runs} episodes, {duration(left)} left")

    return run(several, case, runs, seed, show, named=True)
