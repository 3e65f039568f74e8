"""Keeps a gymnasium environment with discrete actions inside a rule.

    env = ShieldWrapper(gymnasium.make(...), shield, pose_of)
    observation, info = env.reset(seed=0)
    action = rng.choice(env.action_space.n, p=info["distribution"])
    observation, reward, terminated, truncated, info = env.step(action)

`info["distribution"]` is the shield's answer, and `info["action_mask"]` marks the actions to which it gives a
probability above 0. If another action is asked for, the action that the shield drew is executed instead;
`info["executed"]` says which one was. A rule often looks further than the task. So
if the environment terminates while the rule is pending, the episode goes on without reward along the
certified continuation until the rule is decided. The environment has to take steps after it has terminated,
and its time limit has to be later than the rule's horizon.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from operator import index
from typing import Any, SupportsFloat

import gymnasium
import numpy as np
from numpy.typing import ArrayLike

from specshield.client.models import Decision, Pose
from specshield.client.wire import Logits, logit_values
from specshield.errors import InputError, RobotError
from specshield.local import LocalSession, LocalShield
from specshield.local.settings import plain, read_settings

Environment = gymnasium.Env[Any, Any]
RETURNS = {"pose_of": "(x, y, theta)", "logits": "a logit for each action", "possible": "booleans [A]"}
Step = tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]


class ShieldWrapper(gymnasium.Wrapper[Any, Any, Any, Any], gymnasium.utils.RecordConstructorArgs):
    """`env` inside the rule of a shield.

    shield: a shield, or if each episode has its own map, a function that makes one for an environment that
    was just reset. pose_of: returns (x, y, theta) in the map's frame. logits: returns the model's logits, one
    for each action, for an observation and the action executed before it (None at first); by default all
    actions are alike. possible: returns booleans [A], which actions are possible at all, if the shield's
    dynamics do not show that. settings: of `LocalShield.session`; by default the environment moves exactly
    like the shield's robot. Each episode has its own seed, made from the seeds of `settings` and of `reset`.

    Raises InputError at once for an argument of another type and for a wrong setting, and RobotError unless
    the actions are numbered like those of the shield's robot; `reset` does so for a shield that is made then.
    `reset` also raises InfeasibleStart if the rule cannot be kept. `step` raises InputError for an action
    that does not exist. Both raise InputError if `possible` does not return A booleans.
    """

    def __init__(
        self,
        env: Environment,
        shield: LocalShield | Callable[[Environment], LocalShield],
        pose_of: Callable[[Environment], Pose],
        *,
        logits: Callable[[Any, int | None], Logits] | None = None,
        possible: Callable[[Environment], ArrayLike] | None = None,
        **settings: Any,
    ) -> None:
        given = {"shield": shield, "pose_of": pose_of, "logits": logits, "possible": possible, **settings}
        if not (isinstance(given["shield"], LocalShield) or callable(shield)):
            expected = "a LocalShield, such as LocalShield.shipped('case1'), or a function that makes one"
            raise InputError("this is no shield", path="shield", got=shield, expected=expected)
        for name, returns in RETURNS.items():
            if not (callable(given[name]) or (given[name] is None and name != "pose_of")):
                expected = f"a function that returns {returns}"
                raise InputError("this is no function", path=name, got=given[name], expected=expected)
        gymnasium.utils.RecordConstructorArgs.__init__(self, _disable_deepcopy=True, **given)
        gymnasium.Wrapper.__init__(self, env)
        self._shield, self._pose_of, self._logits, self._possible = shield, pose_of, logits, possible
        self._settings = plain({"uncertainty": "none", "learn_map": False, "seed": 0, **settings})
        read_settings(self._settings)
        if isinstance(shield, LocalShield):
            self._check_actions(shield)
        self._since = [0, -1]  # the last seed given to `reset`, and the number of episodes since then
        self.session: LocalSession | None = None
        self.decision: Decision | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        observation, info = self.env.reset(seed=seed, options=options)
        shield = self._shield if isinstance(self._shield, LocalShield) else self._shield(self.env)
        self._check_actions(shield)
        self._since = [self._since[0], self._since[1] + 1] if seed is None else [seed, 0]
        own = np.random.SeedSequence([self._settings["seed"], *self._since])
        settings = self._settings | {"seed": int(own.generate_state(1)[0])}
        self.session = shield.session(initial_pose=self._pose_of(self.env), **settings)
        return observation, {**info, **self._decide(self.session, observation, None, False)}

    def step(self, action: Any) -> Step:
        assert self.session is not None, "reset comes before step"
        assert self.decision is not None
        decision, session, over = self.decision, self.session, self.session.main_task_done
        n, terminal, executed = len(decision.distribution), session.info.terminal_actions, -1
        with suppress(TypeError):  # no whole number
            executed = index(action)
        if not 0 <= executed < n:
            raise InputError("no such action", path="action", got=action, expected=f"0 to {n - 1}")
        ends = executed in terminal and decision.distribution[executed] > 0.0 and not over
        if ends and decision.completion_action is not None:
            executed = decision.completion_action
        elif over or not decision.distribution[executed] > 0.0:
            executed = decision.execute
        observation, reward, terminated, truncated, info = self.env.step(executed)
        told = self._decide(session, observation, executed, over or ends or bool(terminated))
        settled = session.spec_status != "pending"
        terminated = session.main_task_done and settled
        truncated = not terminated and (bool(truncated) or session.finished)
        told |= {"executed": executed, "overruled": executed != index(action)}
        if terminated or truncated:
            told["verdict"] = session.close()
        return observation, 0.0 if over else reward, terminated, truncated, {**info, **told}

    def _check_actions(self, shield: LocalShield) -> None:
        space, n = self.env.action_space, len(shield.task.robot.actions)
        if (getattr(space, "n", None), getattr(space, "start", None)) != (n, 0):
            what = "the environment's actions are not the robot's"
            raise RobotError(what, path="action_space", got=str(space), expected=f"Discrete({n})")

    def _decide(
        self, session: LocalSession, observation: Any, executed: int | None, over: bool
    ) -> dict[str, Any]:
        """Decides the step from the environment's state, and returns the members for `info`."""
        logits = np.zeros(len(session.info.actions))
        if self._logits is not None and not over:
            told = logit_values(self._logits(observation, executed))
            logits = np.array([-np.inf if value is None else value for value in told])
        if self._possible is not None:
            may = np.asarray(self._possible(self.env), bool)
            if may.shape != logits.shape:
                expected = f"a boolean for each of the {len(logits)} actions"
                raise InputError("the shape is wrong", path="possible", got=may.shape, expected=expected)
            logits[~may] = -np.inf
        decision = session.step(self._pose_of(self.env), None if over else logits, main_task_done=over)
        self.decision = decision
        distribution = np.array(decision.distribution)
        return {"action_mask": (distribution > 0.0).astype(np.int8), "distribution": distribution}
