"""The shields and preferences of sessions: this process keeps those that it has prepared."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Awaitable, Callable, Sequence
from concurrent.futures import Future
from dataclasses import replace
from functools import cache
from typing import Any, TypeVar

import msgspec

from specshield import episode
from specshield.arrays import Floats
from specshield.lookahead.preferences import AHEADS, PROJECTION, prepare
from specshield.robot.dynamics import make_body
from specshield.rule.view import view_of
from specshield.service.heavy.background import Background
from specshield.service.heavy.tables import Tables
from specshield.service.heavy.uploads import policies_of
from specshield.service.library import files
from specshield.service.library.policies import Policies
from specshield.service.sessions import record, rules
from specshield.service.sessions.rules import Rule
from specshield.service.sessions.session import Session
from specshield.service.settings import Settings
from specshield.shield.decision import Config, Shield, make_shield
from specshield.shield.preference import Preference

R = TypeVar("R")
Bounds = tuple[float, float]
Run = Callable[..., Awaitable[Any]]  # calls a function in a thread
SHIELDS = 32  # kept in memory; chosen by hand
QUICK = ("reachability", "dqn")  # methods whose decisions take about a millisecond; others may take long


class Shields:
    """Threads may share it. Preferences take seconds to prepare; a thread of its own does that, so that no
    decision waits for it.
    """

    def __init__(self, policies: Policies, is_compiled: Callable[[str], bool] = lambda part: True) -> None:
        """is_compiled: whether the kernels of a part of warmup.LATER are compiled, so that decisions need not
        do it. A method that is quick once they are is called like its part.
        """
        self.policies, self._is_compiled = policies, is_compiled
        self._shields = files.Recent[Shield](SHIELDS)
        self._judges = files.Recent[Shield](SHIELDS)  # shields without policies, for verdicts, by digest
        self._slow = files.Recent[bool](1000)
        self._preferences = files.Recent[Future[Preference]](AHEADS)
        self.tables = Tables()
        self._preparing = Background("prepare")
        self._latest: Future[Preference] | None = None  # the last one that was asked for

    def slow(self, session: Session, long: bool) -> bool:
        """Whether decisions take long and another process can make them, which has no prepared preference.
        long: whether earlier ones did.
        """
        if session.rule.shaping != PROJECTION:
            return False
        over_episode = session.settings.threshold_over == "episode"
        compiles = over_episode and not self._is_compiled("chances")
        return long or compiles or self.slow_policies(session.rule.policy_ids)

    def slow_policies(self, policy_ids: Sequence[str]) -> bool:
        key = tuple(policy_ids)
        slow = self._slow.peek(key)
        if slow is None:
            methods = [self.policies.record(id).about.method for id in key]
            slow = any(method not in QUICK for method in methods)
            if not slow and not all(map(self._is_compiled, methods)):
                return True  # for now
            self._slow.put(key, slow)
        return slow

    def get(self, policy_ids: Sequence[str], config: Config) -> Shield:
        def make() -> Shield:
            return make_shield([self.policies.policy(self.policies.record(id)) for id in policy_ids])

        known = self._shields.get(tuple(policy_ids), make)
        return Shield(known.task, known.proposers, config, known.body, known.view)  # `replace` takes longer

    def of(self, session: Session) -> Shield:
        """The session's shield, with its preference if that is prepared."""
        shield = self.get(session.rule.policy_ids, session.settings)
        if session.rule.shaping == PROJECTION:
            return shield
        return replace(shield, preference=self._preference_at_hand(shield, session))

    async def prepared(
        self, run: Run, shaping: str, keys: Sequence[str], pose: Sequence[float], owner: str
    ) -> Preference:
        """Returns the preference `shaping` for these policies once it is prepared. run: calls a function in a
        thread. Raises FragmentError for a formula that the preference cannot be prepared for.
        """

        def begin() -> Future[Preference]:
            ids = [self.policies.find(key, owner).id for key in keys]
            return self._prepare(shaping, ids, self.get(ids, Config()), pose)

        preference: Preference = await asyncio.shield(asyncio.wrap_future(await run(begin)))
        return preference

    def verdict(self, rule: Rule, rows: Floats, names: Sequence[str]) -> tuple[str, Bounds]:
        """The verdict on a rule by a session's rows [t + 1, 3 + signals], and the bounds on its robustness.

        No policy is needed: the policies of an earlier rule may have been deleted.
        """
        since = rows[rule.origin :]
        if not len(since):
            return "pending", (-math.inf, math.inf)
        asked = record.digest(files.to_json((rule.map_id, rule.robot, rule.spec)))
        judge = self._judges.get(asked, lambda: self._judge(rule))
        return episode.close(judge, since[:, :3], rules.signals_in(since, names))

    def _judge(self, rule: Rule) -> Shield:
        """A shield for verdicts. It is kept, since what `view_of` prepares keeps each task in memory."""
        task = self.policies.task(rule.about)
        body, view = make_body(task.robot, task.grid), view_of(task, task.formula)
        return Shield(task, (), Config(), body, view)

    def settled(self, session: Session) -> Session:
        """The session with the verdicts of the rules that its last switch ended, once x_t is known."""
        begins, state = session.rule.begins, session.state
        if state.finished or state.next_t > begins or len(session.rows) <= begins:
            return session
        last, verdicts = session.rows[: begins + 1], list(state.verdicts)
        for i in range(len(verdicts)):
            if session.rules[i + 1].begins == begins:
                verdicts[i], _ = self.verdict(session.rules[i], last, session.signal_names)
        return session._replace(state=msgspec.structs.replace(state, verdicts=tuple(verdicts)))

    def _prepare(
        self, name: str, policy_ids: Sequence[str], shield: Shield, pose: Sequence[float]
    ) -> Future[Preference]:
        def begin() -> Future[Preference]:
            self._latest = self._preparing.submit(prepare, name, shield.task, shield.proposers, pose)
            return self._latest

        return self._preferences.get((name, *policy_ids), begin)

    def _preference_at_hand(self, shield: Shield, session: Session) -> Preference | None:
        """The session's preference if this process has prepared it; until then the session projects.

        A missing one is begun unless another is being prepared: with more tasks than are kept, requests would
        pile up, and a caller who creates a session would wait for all of them.
        """
        name, ids = session.rule.shaping, session.rule.policy_ids
        found = self._preferences.peek((name, *ids))
        if found is None and (self._latest is None or self._latest.done()):
            found = self._prepare(name, ids, shield, session.poses[-1])
        return found.result() if found is not None and found.done() and found.exception() is None else None


@cache
def _own(settings: Settings) -> Shields:
    return Shields(policies_of(settings))


def call(settings: Settings, function: Callable[..., R], *arguments: Any) -> R:
    """Calls the function in a process for decisions (heavy/heavy.py), with the shields of that process."""
    return function(_own(settings), *arguments)
