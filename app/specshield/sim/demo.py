"""`specshield demo`: runs both cases over HTTP, prints a table of results, and draws a picture of each."""

from __future__ import annotations

import contextlib
import signal
import sys
import time
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import Executor, Future
from pathlib import Path

import numpy as np

from specshield.sim import picture
from specshield.sim.campaign import Campaign, robots, run
from specshield.sim.cases import case_names, load_case
from specshield.sim.episodes import Episode
from specshield.sim.progress import StatusLine, duration
from specshield.sim.service import own_server

MODES = ("shaped", "completion", "prior", "fallback", "violated")


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
    print(f"\n{table(campaigns)}\n")
    print("\n".join(f"picture: {out / campaign.case.name}.svg" for campaign in campaigns))


def _campaign(several: Executor, case: str, runs: int, seed: int, status: StatusLine) -> Campaign:
    began = time.monotonic()

    def show(done: int) -> None:
        left = (time.monotonic() - began) / done * (runs - done)
        status.say(f"{case}: {done} of {runs} episodes, {duration(left)} left")

    return run(several, case, runs, seed, show, named=True)


def table(campaigns: Sequence[Campaign]) -> str:
    """The table, with two columns for each case: without and with the shield."""
    columns = [column for each in campaigns for column in (_outcome(each.unshielded), _shielded(each))]
    names = list(columns[1])
    cells = [[name, *(column.get(name, "") for column in columns)] for name in names]
    heads = [["", *(each.case.name if i == 0 else "" for each in campaigns for i in range(2))]]
    heads.append(["", *("without", "with shield") * len(campaigns)])
    rows = heads + [row for row in cells if row[0] != "  violated" or set(row[1:]) > {"", "0"}]
    wide = [max(len(row[c]) for row in rows) for c in range(len(rows[0]))]
    lines = ["  ".join([row[0].ljust(wide[0]), *map(str.rjust, row[1:], wide[1:])]) for row in rows]
    return "\n".join(line.rstrip() for line in lines)


def _outcome(episodes: Sequence[Episode]) -> dict[str, str]:
    kept = sum(episode.spec_status == "satisfied" for episode in episodes)
    done = sum(episode.main_done for episode in episodes)
    return {"rule satisfied": f"{kept} of {len(episodes)}", "main task done": f"{done} of {len(episodes)}"}


def _shielded(campaign: Campaign) -> dict[str, str]:
    """The column of the episodes with the shield.

    KL: the distance of the decisions from the model's distribution [nats], per decision and summed over an
    episode. Extra steps: how much later the model ended than without the shield, if it did its task both
    times. More than one action left: the share of decisions that were `shaped` and left the model a choice,
    among those while the rule was pending and the main task ran.
    """
    shielded = campaign.shielded
    modes = sum((episode.modes for episode in shielded), Counter[str]())
    kl = [value for episode in shielded for value in episode.kl]
    later = [
        one.ended_at - other.ended_at
        for one, other in zip(shielded, campaign.unshielded, strict=True)
        if one.main_done and other.main_done and one.ended_at is not None and other.ended_at is not None
    ]
    asked = sum(episode.asked for episode in shielded)
    spread = sum(episode.spread for episode in shielded)
    return {
        **_outcome(shielded),
        "KL a decision": f"{np.mean(kl):.2f}" if kl else "-",
        "KL an episode": f"{sum(kl) / len(shielded):.0f}",
        "median extra steps": f"{np.median(later):+.0f}" if later else "-",
        "decisions": str(modes.total()),
        **{f"  {mode}": str(modes[mode]) for mode in MODES},
        "more than one action left": f"{spread / asked:.1%}" if asked else "-",
        "a decision, p50 / p99": _times([ms for episode in shielded for ms in episode.round_trip_ms]),
        "  of it in the server": _times([ms for episode in shielded for ms in episode.server_ms]),
        "starts refused": f"{campaign.refused} of {len(shielded) + campaign.refused}",
    }


def _times(milliseconds: Sequence[float]) -> str:
    middle, high = np.percentile(milliseconds, (50, 99))
    return f"{middle:.1f} / {high:.1f} ms"
