"""`specshield watch`: the decisions of a session in the terminal, as they are made."""

from __future__ import annotations

import os

from specshield.client import Decision, ShieldClient

HEAD = "    t mode           action       rule  feasible      KL   rho m   off by m"


def watch(session: str, url: str, after: int | None, limit: int | None) -> int:
    """Prints one line a decision until the session ends, or `limit` lines. The exit status is 0."""
    with ShieldClient(url, api_key=os.environ.get("SPECSHIELD_API_KEY")) as client:
        found = client.sessions.get(session)
        print(f"session {found.id}: {found.info.spec['formula']}")
        print(HEAD, flush=True)
        for seen, decision in enumerate(found.events(-1 if after is None else after), 1):
            print(line(decision), flush=True)
            for warning in decision.warnings:
                print(f"      {warning}", flush=True)
            if seen == limit:
                break
    return 0


def line(decision: Decision) -> str:
    """One decision; what was not evaluated is a dash."""
    rho = decision.robustness[decision.action]
    off = None if decision.residual is None else decision.residual.translation
    mode = decision.mode if decision.reason is None else f"{decision.mode}*"
    told = f"{decision.t:5} {mode:10} {decision.action_name:>10} {decision.spec_status:>10}"
    numbers = (
        f"{_number(decision.feasible_mass, 3):>9} {_number(decision.kl, 3):>7} {_number(rho, 2):>7}"
        f" {_number(off, 3):>10}"
    )
    return f"{told} {numbers}{'' if decision.reason is None else '  *' + decision.reason}"


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
