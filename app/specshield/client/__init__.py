"""The SDK: `ShieldClient` and `AsyncShieldClient`, their answers, and one class of error a problem.

    from specshield.client import ShieldClient

    with ShieldClient("http://127.0.0.1:8000") as client:
        with client.sessions.create(policy_id="case1", initial_pose=(x, y, theta)) as session:
            while not session.finished:
                decision = session.step(robot.pose(), model.logits())
                robot.execute(decision.execute)

Errors are those of `specshield.errors`. Needs httpx and nothing else.
"""

from specshield.client.aio import AsyncSession, AsyncShieldClient
from specshield.client.models import (
    Decision,
    Explanation,
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
    "AsyncSession",
    "AsyncShieldClient",
    "Decision",
    "Explanation",
    "LocalDecision",
    "Map",
    "Policy",
    "Residual",
    "Session",
    "SessionInfo",
    "ShieldClient",
    "Spec",
    "TrajectoryItem",
    "Verdict",
]
