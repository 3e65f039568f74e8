"""`specshield watch`: shows the decisions of a session in the terminal as they are made."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:  # every command imports this module
    from specshield.client import Decision

HEAD = "    t mode           action       rule  feasible      KL   rho m   off by m"


def watch(
    session: Annotated[str, typer.Argument(help="Id of a session.")],
    url: Annotated[str, typer.Option(help="The server (key: SPECSHIELD_API_KEY).")] = "http://127.0.0.1:8000",
    after: Annotated[int, typer.Option(help="Begin after this step; -1: at the first one.", min=-1)] = -1,
    limit: Annotated[int | None, typer.Option(help="Stop after so many decisions.", min=1)] = None,
) -> None:
    """Show the decisions of a session as they are made, one in each line."""
    from specshield.commands.serving import client_at

    with client_at(url) as client:
        found = client.sessions.get(session)
        rule = found.rule_at(after + 1)
        print(f"session {found.id}: {rule}")
        print(HEAD, flush=True)
        for seen, decision in enumerate(found.events(after), 1):
            if rule != found.rule_at(decision.t):
                rule = found.rule_at(decision.t)
                print(f"from step {decision.t}: {rule}", flush=True)
            print(line(decision), flush=True)
            for warning in decision.warnings:
                print(f"      {warning}", flush=True)
            if seen == limit:
                break


def line(decision: Decision) -> str:
    """A decision as a line, with a dash for each value that was not computed."""
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
