"""Campaigns as a table to read and as JSON to keep."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

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
    shielded, pairs = campaign.shielded, zip(campaign.shielded, campaign.unshielded, strict=True)
    extra = [
        s.ended_at - u.ended_at for s, u in pairs if s.main_done and u.main_done and s.ended_at and u.ended_at
    ]
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
    rows: list[tuple[str, list[str]]] = [("", []), ("", [])]
    names = (
        "rule satisfied",
        "main task done",
        "KL a decision",
        "KL an episode",
        "median extra steps",
        "decisions",
    )
    rows += [(name, []) for name in (*names, *(f"  {mode}" for mode in MODES), "more than one action left")]
    rows += [(name, []) for name in ("a decision, p50 / p99", "  of it in the server", "starts refused")]
    columns = [column for one in summaries for column in _columns(one)]
    for i, (_, cells) in enumerate(rows):
        cells.extend(column[i] for column in columns)
    rows = [
        row for row in rows if row[0].strip() not in MODES or any(cell not in ("", "0") for cell in row[1])
    ]
    wide = [max(len(cells[c]) for _, cells in rows) for c in range(len(columns))]
    first = max(len(name) for name, _ in rows)
    return "\n".join(
        "  ".join([name.ljust(first), *(cell.rjust(w) for cell, w in zip(cells, wide, strict=True))]).rstrip()
        for name, cells in rows
    )


def _columns(one: dict[str, Any]) -> tuple[list[str], list[str]]:
    runs, bare, kept = one["runs"], one["without_shield"], one["with_shield"]

    def outcome(name: str, figures: dict[str, Any]) -> list[str]:
        return [f"{figures['satisfied']} of {runs}", f"{figures['main_done']} of {runs}"]

    def number(value: float | None, form: str) -> str:
        return "-" if value is None else form.format(value)

    def times(figures: dict[str, float]) -> str:
        return f"{figures['p50']:.1f} / {figures['p99']:.1f} ms"

    with_shield = [
        "",
        "with shield",
        *outcome(one["case"], kept),
        number(kept["kl_per_decision"], "{:.2f}"),
        number(kept["kl_per_episode"], "{:.0f}"),
        number(kept["extra_steps"], "{:+.0f}"),
        str(sum(kept["modes"].values())),
        *(str(kept["modes"].get(mode, 0)) for mode in MODES),
        number(kept["spread"], "{:.1%}"),
        times(kept["round_trip_ms"]),
        times(kept["server_ms"]),
        f"{one['refused_starts']} of {runs + one['refused_starts']}",
    ]
    without = [one["case"], "without", *outcome(one["case"], bare)]
    return without + [""] * (len(with_shield) - len(without)), with_shield


def _outcome(episodes: Sequence[Episode]) -> dict[str, Any]:
    return {
        "satisfied": sum(episode.spec_status == "satisfied" for episode in episodes),
        "main_done": sum(episode.main_done for episode in episodes),
    }


def _percentiles(values: Sequence[float]) -> dict[str, float]:
    return {f"p{q:g}": _rounded(np.percentile(values, q)) for q in (50, 90, 99)}


def _rounded(value: Any) -> float:
    return round(float(value), 4)
