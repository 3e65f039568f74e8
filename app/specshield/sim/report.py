"""The demo's campaigns as a table."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np

from specshield.sim.campaign import Campaign
from specshield.sim.episodes import Episode

MODES = ("shaped", "completion", "prior", "fallback", "violated")


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
