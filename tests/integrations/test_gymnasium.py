"""The gymnasium wrapper, on an environment and with an agent that this project did not make."""

from __future__ import annotations

import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

gymnasium = pytest.importorskip("gymnasium")
pytest.importorskip("minigrid")

from gymnasium.utils.env_checker import check_env  # noqa: E402

from examples import minigrid_rooms  # noqa: E402
from specshield.errors import InfeasibleStart, InputError, LogitsError, RobotError  # noqa: E402
from specshield.integrations import minigrid  # noqa: E402
from specshield.integrations.gymnasium import ShieldWrapper  # noqa: E402
from specshield.local import LocalShield  # noqa: E402
from specshield.sim.cases import load_case  # noqa: E402
from specshield.sim.robot import SimulatedRobot  # noqa: E402
from tests.serving import HUNG  # noqa: E402

EXAMPLE = Path(minigrid_rooms.__file__)
START = (4.5, 5.0, 0.0)


def inside(env: gymnasium.Env, column: int, row: int) -> bool:
    """Whether MiniGrid's own numbers have the agent in that room, off its walls."""
    room, (x, y) = env.unwrapped.room_grid[row][column], env.unwrapped.agent_pos
    (left, top), (width, height) = room.top, room.size
    return left < x < left + width - 1 and top < y < top + height - 1


def test_a_random_model_keeps_the_rule_in_every_episode() -> None:
    """Judged here by the rooms of MiniGrid, with the rule of the example taken apart by hand."""
    env, kept = minigrid_rooms.maze(minigrid_rooms.chance), 0
    env.unwrapped.agent_view_size = 3  # the least: to see takes half of a step, and chance looks at nothing
    for seed in range(30):
        random = np.random.default_rng(seed)
        _, info = env.reset(seed=seed)
        first, second, over = [inside(env, 0, 0)], [inside(env, 1, 1)], False
        while not over:
            _, _, terminated, truncated, info = env.step(int(random.integers(7)))
            first.append(inside(env, 0, 0))
            second.append(inside(env, 1, 1))
            over = terminated or truncated
        assert len(first) > 90
        keeps = any(first[:41]) and any(second[50:91]) and not any(first[60:91])
        assert keeps == (info["verdict"].spec_status == "satisfied")
        kept += keeps
    assert kept == 30


def test_the_bot_does_its_mission_within_the_rule(caplog: pytest.LogCaptureFixture) -> None:
    env = minigrid_rooms.maze(minigrid_rooms.bot)
    ends = [minigrid_rooms.drive(env, seed) for seed in range(10)]
    assert ends == [("satisfied", True)] * 10
    assert not caplog.records  # nothing is wrong with any of these mazes


def test_the_checker_of_gymnasium_passes() -> None:
    """It draws mazes of its own, and in one of a hundred a thing lies in front of the only door of a room."""
    maze = gymnasium.make(
        "BabyAI-GoToObjMazeOpen-v0", room_size=6, num_rows=2, num_cols=2, max_steps=120,
        disable_env_checker=True,
    )  # fmt: skip
    env = minigrid.shielded(maze, minigrid_rooms.RULE, allow_infeasible=True)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*(different from the unwrapped|spec is None|render).*")
        check_env(env, skip_render_check=True)


def test_the_example() -> None:
    done = subprocess.run(
        [sys.executable, str(EXAMPLE), "2"], capture_output=True, text=True, check=True, timeout=HUNG
    )
    bot, chance = done.stdout.splitlines()
    assert bot == "the bot: the rule was kept in 2 of 2 episodes, the mission done in 2"
    assert chance.startswith("a model that draws at random: the rule was kept in 2 of 2 episodes")


def test_a_maze_in_which_the_rule_cannot_be_kept_is_refused() -> None:
    """In the maze of seed 378 a key lies behind the only door of Room_0_0."""
    with pytest.raises(
        InfeasibleStart, match=r"on the best of \d+ ways tried 'F\[0,40\] Room_0_0' is missed"
    ):
        minigrid_rooms.maze(minigrid_rooms.chance).reset(seed=378)


def test_an_environment_that_is_not_of_minigrid_is_refused_at_once() -> None:
    with pytest.raises(InputError, match=r"env: this is no MiniGrid environment; got .*CartPole"):
        minigrid.shielded(gymnasium.make("CartPole-v1"), "F[0,9] Room_0_0")


class House(gymnasium.Env[Any, Any]):
    """A case's apartment; its task is done when the robot says so."""

    def __init__(self) -> None:
        self.action_space = gymnasium.spaces.Discrete(20)
        self.observation_space = gymnasium.spaces.Discrete(1)
        self.executed: list[int] = []

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[int, dict[str, Any]]:
        super().reset(seed=seed)
        self.robot = SimulatedRobot(load_case("case1"), START)
        return 0, {}

    def step(self, action: int) -> tuple[int, float, bool, bool, dict[str, Any]]:
        self.executed.append(action)
        self.robot.execute(action)
        return 0, 1.0, False, False, {}


def test_an_agent_that_ends_its_task_leaves_the_rule_to_the_shield() -> None:
    house = House()
    env = ShieldWrapper(house, LocalShield.shipped("case1"), lambda env: env.unwrapped.robot.pose, seed=2)
    env.reset(seed=0)
    rewards, terminated, info = [], False, {}
    while not terminated:
        wanted = 4 if len(rewards) == 5 else 0  # forward, `end`, and nothing else
        _, reward, terminated, truncated, info = env.step(wanted)
        assert not truncated
        rewards.append(reward)
    assert info["verdict"].spec_status == "satisfied"
    assert len(rewards) == 80  # the second visit cannot be before
    assert sum(rewards) == 6.0  # none for what the shield did alone
    assert 4 not in house.executed


def test_each_episode_draws_anew_and_a_seed_gives_one_back() -> None:
    env = ShieldWrapper(House(), LocalShield.shipped("case1"), lambda env: START, seed=3)
    told = []
    for seed in (7, None, 8, 7, None):
        env.reset(seed=seed)
        assert env.decision is not None
        told.append(env.decision.execute)
    assert told[:2] == told[3:]
    assert len(set(told)) == 3


def test_an_action_that_there_is_not_does_not_reach_the_environment() -> None:
    house = House()
    env = ShieldWrapper(house, LocalShield.shipped("case1"), lambda env: START)
    env.reset()
    for action in (-1, 20, 1.7, np.array(1.7), np.array(np.nan), float("nan"), None, "m", np.array([0, 1])):
        with pytest.raises(InputError, match="0 to 19"):
            env.step(action)
    assert house.executed == []


@pytest.mark.parametrize(
    ("path", "wrong"),
    [
        ("seed", -1), ("seed", None), ("seed", 1.5), ("margin", "wide"), ("marign", 0.1),
        ("initial_pose", START), ("pose_of", None), ("pose_of", START), ("logits", [0.0] * 20),
        ("possible", np.ones(20, bool)),
    ],
)  # fmt: skip
def test_an_argument_that_cannot_be_used_is_refused_at_once(path: str, wrong: Any) -> None:
    with pytest.raises(InputError, match=path):
        ShieldWrapper(House(), LocalShield.shipped("case1"), **{"pose_of": lambda env: START, path: wrong})


def test_a_mask_of_another_length_is_refused() -> None:
    shield, mask = LocalShield.shipped("case1"), np.ones(6, bool)
    env = ShieldWrapper(House(), shield, lambda env: START, possible=lambda env: mask)
    with pytest.raises(InputError, match="possible"):
        env.reset()


@pytest.mark.parametrize("wrong", ["case1", None])
def test_what_is_no_shield_is_refused_at_once(wrong: Any) -> None:
    with pytest.raises(InputError, match=r"this is no shield.*; expected a LocalShield"):
        ShieldWrapper(House(), wrong, lambda env: START)


def test_a_seed_of_numpy_is_a_seed() -> None:
    shield, actions = LocalShield.shipped("case1"), list[int]()
    for seed in (3, np.int64(3)):
        env = ShieldWrapper(House(), shield, lambda env: START, seed=seed)
        env.reset(seed=0)
        assert env.decision is not None
        actions.append(env.decision.action)
    assert actions[0] == actions[1]


@pytest.mark.parametrize("space", [gymnasium.spaces.Discrete(7), gymnasium.spaces.Discrete(20, start=1)])
def test_other_actions_than_the_robots_are_refused(space: Any) -> None:
    """Also those that are counted from another number: each would be taken for the next."""
    house = House()
    house.action_space = space
    shield = LocalShield.shipped("case1")
    with pytest.raises(RobotError, match=r"expected Discrete\(20\)"):
        ShieldWrapper(house, shield, lambda env: START)
    made_later = ShieldWrapper(house, lambda env: shield, lambda env: START)
    with pytest.raises(RobotError, match=r"expected Discrete\(20\)"):
        made_later.reset()


def test_a_model_may_answer_with_whatever_a_session_takes_for_logits() -> None:
    torch = pytest.importorskip("torch")
    answers = iter([[None, *[0.0] * 19], torch.zeros(20, requires_grad=True), None])
    env = ShieldWrapper(
        House(), LocalShield.shipped("case1"), lambda env: START, logits=lambda seen, before: next(answers)
    )
    assert env.reset()[1]["distribution"][0] == 0.0
    env.step(1)
    with pytest.raises(LogitsError, match="this is no list of numbers; got 'None'"):
        env.step(1)
