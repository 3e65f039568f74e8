"""Campaigns as a table to read and as JSON to keep."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from evaluation.statistics import extra_steps
from specshield.sim.campaign import Campaign
from specshield.sim.episodes import Episode

MODES = ("shaped", "completion", "prior", "fallback", "violated")


def summary(campaign: Campaign) -> dict[str, Any]:
    """The figures of a campaign, as JSON.

    kl_per_decision, kl_per_episode [nats]: mean over the decisions made for the model, and of their sums.
    extra_steps: median of how much later the model ended with the shield, where it did its task both times.
    spread: of the decisions made while the rule was pending and the main task ran, the share that was
    `shaped` and left the model more than one action. round_trip_ms, server_ms: of one decision.
    """
    shielded = campaign.shielded
    extra = extra_steps(zip(shielded, campaign.unshielded, strict=True))
    kl = [value for episode in shielded for value in episode.kl]
    asked = sum(episode.asked for episode in shielded)
    return {
        "case": campaign.case.name,
        "formula": str(campaign.case.task.formula),
        "instruction": campaign.case.instruction,
        "seed": campaign.seed,
        "runs": len(shielded),
        "refused_starts": campaign.refused,
        "without_shield": _outcome(campaign.unshielded),
        "with_shield": {
            **_outcome(shielded),
            "kl_per_decision": _rounded(np.mean(kl)) if kl else None,
            "kl_per_episode": _rounded(np.mean([sum(episode.kl) for episode in shielded])),
            "extra_steps": _rounded(np.median(extra)) if extra else None,
            "modes": dict(sum((episode.modes for episode in shielded), Counter[str]())),
            "spread": _rounded(sum(episode.spread for episode in shielded) / asked) if asked else None,
            "round_trip_ms": _percentiles([ms for episode in shielded for ms in episode.round_trip_ms]),
            "server_ms": _percentiles([ms for episode in shielded for ms in episode.server_ms]),
        },
    }


def table(summaries: Sequence[dict[str, Any]]) -> str:
    """One pair of columns a case, without and with the shield."""
    columns = [column for one in summaries for column in (_without(one), _with(one))]
    names = list(columns[1])
    cells = [[name, *(column.get(name, "") for column in columns)] for name in names]
    heads = [["", *(one["case"] if i == 0 else "" for one in summaries for i in range(2))]]
    heads.append(["", *("without", "with shield") * len(summaries)])
    rows = heads + [row for row in cells if row[0] != "  violated" or set(row[1:]) > {"", "0"}]
    wide = [max(len(row[c]) for row in rows) for c in range(len(rows[0]))]
    lines = ["  ".join([row[0].ljust(wide[0]), *map(str.rjust, row[1:], wide[1:])]) for row in rows]
    return "\n".join(line.rstrip() for line in lines)


def _without(one: dict[str, Any]) -> dict[str, str]:
    runs, figures = one["runs"], one["without_shield"]
    return {
        "rule satisfied": f"{figures['satisfied']} of {runs}",
        "main task done": f"{figures['main_done']} of {runs}",
    }


def _with(one: dict[str, Any]) -> dict[str, str]:
    runs, refused, figures = one["runs"], one["refused_starts"], one["with_shield"]
    modes = figures["modes"]
    return {
        "rule satisfied": f"{figures['satisfied']} of {runs}",
        "main task done": f"{figures['main_done']} of {runs}",
        "KL a decision": _number(figures["kl_per_decision"], ".2f"),
        "KL an episode": _number(figures["kl_per_episode"], ".0f"),
        "median extra steps": _number(figures["extra_steps"], "+.0f"),
        "decisions": str(sum(modes.values())),
        **{f"  {mode}": str(modes.get(mode, 0)) for mode in MODES},
        "more than one action left": _number(figures["spread"], ".1%"),
        "a decision, p50 / p99": _times(figures["round_trip_ms"]),
        "  of it in the server": _times(figures["server_ms"]),
        "starts refused": f"{refused} of {runs + refused}",
    }


def _number(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)


def _times(figures: dict[str, float]) -> str:
    return f"{figures['p50']:.1f} / {figures['p99']:.1f} ms"


def _outcome(episodes: Sequence[Episode]) -> dict[str, Any]:
    return {
        "satisfied": sum(episode.spec_status == "satisfied" for episode in episodes),
        "main_done": sum(episode.main_done for episode in episodes),
    }


def _percentiles(values: Sequence[float]) -> dict[str, float]:
    return {f"p{q:g}": _rounded(np.percentile(values, q)) for q in (50, 90, 99)}


def _rounded(value: Any) -> float:
    return round(float(value), 4)
