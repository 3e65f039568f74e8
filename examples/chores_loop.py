"""The evaluation loops of SPOC, PoliFormer and FLaRe with the shield between the agent and the simulator.

Their loop asks an agent for an action and steps a task with the action's name. In `drive`, the agent's
probabilities go to the shield, and the task is stepped with the shield's answer. The agent is then told what
was executed: both kinds of agent feed their own draw back into their memory, and the shield may have
overruled it.

**Not run with the real models.** Neither their weights nor their simulator (AI2-THOR with Objaverse houses)
could be had where this was written. It follows their public sources (spoc-robot-training, PoliFormer and
FLaRe: `online_evaluation/online_evaluator_worker.py`, `environment/stretch_controller.py`, the agents in
`architecture/models`), and its test drives it with objects that have the fields and shapes found there.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from specshield.client import Session
from specshield.errors import LogitsError, PoseError, RobotError
from specshield.local import LocalSession
from specshield.robot import STRETCH
from specshield.robot.dynamics import wrap

Floats = NDArray[np.float64]
END = "end"


class Agent(Protocol):
    """What their agents have in common. get_action: the name drawn, and 20 probabilities."""

    def reset(self) -> None: ...
    def get_action_list(self) -> Sequence[str]: ...
    def get_action(self, observations: Any, goal_spec: str) -> tuple[str, Any]: ...


def pose_of(agent: Mapping[str, Any]) -> tuple[float, float, float]:
    """The pose in the frame of a ProcTHOR map, from `controller.get_current_agent_full_pose()`.

    Theirs: Unity's left-handed frame, y up, `position` in metres, `rotation.y` in degrees clockwise from z.
    Ours: (x, y, theta) = (x, z, pi/2 - yaw). Raises PoseError.
    """
    try:
        x, z = float(agent["position"]["x"]), float(agent["position"]["z"])
        yaw = float(agent["rotation"]["y"])
    except (KeyError, TypeError, ValueError) as error:
        raise PoseError(
            "not an agent's pose", path="agent", got=repr(agent)[:200],
            expected="position x and z in metres, rotation y in degrees",
        ) from error  # fmt: skip
    return x, z, float(wrap(0.5 * math.pi - math.radians(yaw)))


def check_actions(names: Sequence[str]) -> None:
    """Raises RobotError unless these are the 20 Stretch tokens in their order.

    Theirs can be replaced (ACTION_DICT in the environment): other motions would be made than were judged.
    """
    if tuple(names) != STRETCH.action_names:
        raise RobotError(
            "the agent's actions are not the Stretch's", path="actions", got=list(names),
            expected=f"{list(STRETCH.action_names)}, in this order",
        )  # fmt: skip


def logits_of(probabilities: Any) -> Floats:
    """Logits (20,) that softmax turns back into the probabilities; -inf for none. Raises LogitsError.

    probabilities (20,): what `get_action` returns beside the name, on the CPU. Agents that draw greedily or
    with a temperature sample from another distribution: give that one.
    """
    p = np.asarray(probabilities, dtype=np.float64)
    if (
        p.shape != (len(STRETCH.actions),)
        or not (p >= 0.0).all()
        or not math.isclose(p.sum(), 1.0, abs_tol=1e-3)
    ):
        raise LogitsError(
            "not a distribution over the agent's actions", path="probabilities", got=f"shape {list(p.shape)}",
            expected=f"{len(STRETCH.actions)} numbers from 0 that sum to 1",
        )  # fmt: skip
    with np.errstate(divide="ignore"):
        logits: Floats = np.log(p)
    return logits


def feed_back(agent: Any, action: int) -> None:
    """Puts the action that was executed, an index, where the agent keeps its own last draw.

    SPOC (EarlyFusionCnnTransformerAgent): `cache["last_actions"]`, shape (1, 1), there only if the model was
    trained with that input. PoliFormer and FLaRe (allenact's InferenceAgent): `last_action_flat`, which goes
    into the rollout storage at the next step.
    """
    if hasattr(agent, "last_action_flat"):
        agent.last_action_flat[...] = action
    elif "last_actions" in getattr(agent, "cache", {}):
        agent.cache["last_actions"][...] = action


def drive(task: Any, agent: Agent, session: Session | LocalSession) -> bool:
    """One episode of a task of theirs, shielded; whether the agent had done it where it ended.

    task: an AbstractSPOCTask in a house whose map the session's policy was made for. session: just begun at
    the agent's pose. When the rule outlasts the task, the shield goes on alone; the task's `end` comes last.
    """
    names = agent.get_action_list()
    check_actions(names)
    goal, done = task.task_info["natural_language_spec"], False
    agent.reset()
    with session:
        while not session.finished and not task.is_done():
            pose, main_over = pose_of(task.controller.get_current_agent_full_pose()), session.main_task_done
            logits = None
            if not main_over:
                _, probabilities = agent.get_action(task.get_observations(), goal)
                logits = logits_of(probabilities)
            decision = session.step(pose, logits)
            if session.main_task_done and not main_over:
                done = bool(task.successful_if_done())
            if not session.finished:
                feed_back(agent, decision.execute)
                task.step_with_action_str(names[decision.execute])
    if not task.is_done():
        task.step_with_action_str(END)
    return done
