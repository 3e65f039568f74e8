"""The SDK: `ShieldClient` and `AsyncShieldClient`, their answers, and one class of error for each problem.

    from specshield.client import ShieldClient

    with ShieldClient("http://127.0.0.1:8000") as client:
        with client.sessions.create(policy_id="case1", initial_pose=(x, y, theta)) as session:
            while not session.finished:
                decision = session.step(robot.pose(), model.logits())
                robot.execute(decision.execute)

The errors are those of `specshield.errors`. The SDK needs httpx and nothing else. Its names are imported when
they are first used, since `specshield.local` uses the classes of `models` without httpx.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from specshield.client.aio import AsyncSession, AsyncShieldClient
    from specshield.client.models import (
        Decision,
        Explanation,
        Learned,
        LocalDecision,
        Map,
        Policy,
        Residual,
        SessionInfo,
        Spec,
        TrajectoryItem,
        Verdict,
    )
    from specshield.client.sync import Session, ShieldClient

__all__ = [
    "AsyncSession", "AsyncShieldClient", "Decision", "Explanation", "Learned", "LocalDecision", "Map",
    "Policy", "Residual", "Session", "SessionInfo", "ShieldClient", "Spec", "TrajectoryItem", "Verdict",
]  # fmt: skip

_SHELLS = {"AsyncSession": "aio", "AsyncShieldClient": "aio", "Session": "sync", "ShieldClient": "sync"}


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_SHELLS.get(name, 'models')}"), name)


def __dir__() -> list[str]:
    return __all__
