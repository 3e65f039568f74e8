"""The shields and preferences that this process has prepared: taken from memory, or made."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace

from specshield.errors import FragmentError
from specshield.lookahead.lookahead import AHEADS
from specshield.lookahead.preferences import PROJECTION, prepare
from specshield.service.library import files
from specshield.service.library.policies import Policies
from specshield.service.schemas.sessions import SessionRequest
from specshield.service.sessions.config import settings_of
from specshield.service.sessions.session import Session
from specshield.shield.decision import Config, Shield, make_shield
from specshield.shield.preference import Preference

QUICK = ("reachability", "dqn")  # methods whose decisions take a millisecond; of others nothing is known


class Shields:
    """Threads may share it. Preparing a preference takes seconds, in a thread of its own, so that no decision
    waits for it.
    """

    def __init__(self, policies: Policies, room: int) -> None:
        self._policies, self._shields = policies, files.Recent[Shield](room)
        self._slow = files.Recent[bool](1000)
        self._preferences = files.Recent[Future[Preference]](AHEADS)
        self._preparing = ThreadPoolExecutor(1, "prepare")
        self._latest: Future[Preference] | None = None  # the last one that was asked for

    def slow(self, session: Session) -> bool:
        """Whether its decisions take long. A session with a preference stays where that is prepared."""
        if session.config["shaping"] != PROJECTION:
            return False
        return self.slow_policies(session.config["policy_ids"])

    def slow_policies(self, policy_ids: Sequence[str]) -> bool:
        key = tuple(policy_ids)
        return self._slow.get(
            key, lambda: any(self._policies.record(id).about.method not in QUICK for id in key)
        )

    def note_slow(self, session: Session) -> None:
        """One of its decisions has taken long."""
        key = tuple(session.config["policy_ids"])
        self._slow.drop(key)
        self._slow.get(key, lambda: True)

    def get(self, policy_ids: Sequence[str], config: Config) -> Shield:
        def make() -> Shield:
            return make_shield([self._policies.policy(self._policies.record(id)) for id in policy_ids])

        return replace(self._shields.get(tuple(policy_ids), make), config=config)

    def of(self, session: Session) -> Shield:
        """The session's shield, with its preference if that is at hand."""
        shield = self.get(session.config["policy_ids"], settings_of(session.config))
        if session.config["shaping"] == PROJECTION:
            return shield
        return replace(shield, preference=self._preference_at_hand(shield, session))

    def prepared(self, request: SessionRequest, owner: str) -> Future[Preference]:
        """The preference that a new session asks for, or will be."""
        ids = [self._policies.find(key, owner).id for key in request.policies]
        return self._prepare(request.shaping, ids, self.get(ids, Config()), request.initial_pose)

    def _prepare(
        self, name: str, policy_ids: Sequence[str], shield: Shield, pose: Sequence[float]
    ) -> Future[Preference]:
        def begin() -> Future[Preference]:
            self._latest = self._preparing.submit(prepare, name, shield.task, shield.proposers, pose)
            return self._latest

        return self._preferences.get((name, *policy_ids), begin)

    def _preference_at_hand(self, shield: Shield, session: Session) -> Preference | None:
        """The session's preference if this process has prepared it; until then the session projects.

        What is missing is begun, unless another is being prepared: with more tasks than are kept they would
        pile up, and whoever creates a session would wait for them all.
        """
        name, ids = session.config["shaping"], session.config["policy_ids"]
        found = self._preferences.peek((name, *ids))
        if found is None and (self._latest is None or self._latest.done()):
            found = self._prepare(name, ids, shield, session.poses[-1])
        return found.result() if found is not None and found.done() and found.exception() is None else None


def refused(shaping: str, error: FragmentError) -> FragmentError:
    """What a caller is told whose preference cannot be prepared for the formula."""
    return FragmentError(
        f"{shaping!r} cannot be had for this formula: {error.message}", path="shaping", got=shaping,
        expected="'projection', or a formula that 'reachability' takes",
    )  # fmt: skip
