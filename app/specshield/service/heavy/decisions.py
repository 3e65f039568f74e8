"""The calls of a process for decisions: the server's own functions, with shields that it prepares itself."""

from __future__ import annotations

from functools import cache

from specshield.service.heavy.uploads import policies_of
from specshield.service.schemas.sessions import SessionRequest
from specshield.service.schemas.steps import StepBody
from specshield.service.sessions import sessions, steps, switch
from specshield.service.sessions.session import Session
from specshield.service.sessions.shields import Shields
from specshield.service.sessions.switch import Wanted
from specshield.service.settings import Settings
from specshield.shield.decision import Config


@cache
def _shields(settings: Settings) -> Shields:
    return Shields(policies_of(settings), settings.shield_cache)


def step(settings: Settings, session: Session, request: StepBody) -> tuple[steps.Decided, float]:
    """The decided step, and the seconds that the decision took."""
    return steps.timed(_shields(settings), session, request)[:2]


def begin(settings: Settings, request: SessionRequest, config: Config, owner: str) -> sessions.Begun:
    return sessions.begin(_shields(settings), request, config, None, owner)


def switched(settings: Settings, wanted: Wanted, most_steps: int) -> Session:
    return switch.switched(_shields(settings), wanted, most_steps)
