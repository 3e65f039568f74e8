"""BabyAI's own bot in its own maze, inside a rule over the rooms that the bot knows nothing of.

    pip install -e '.[minigrid]'
    python examples/minigrid_rooms.py          # in process: no service is needed

The bot goes where its mission says. The rule wants it in one corner of the maze in time, in the opposite one
later, and out of the first while the second is open. The same is done with a model that draws at random.
"""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Callable
from typing import Any

import gymnasium
import minigrid  # noqa: F401  registers its environments
import numpy as np
from minigrid.utils.baby_ai_bot import BabyAIBot

from specshield.errors import InfeasibleStart
from specshield.integrations.gymnasium import ShieldWrapper
from specshield.integrations.minigrid import shielded

RULE = "F[0,40] Room_0_0 and F[50,90] Room_1_1 and G[60,90] not Room_0_0"
SURE = 4.0  # nats by which the bot prefers its own action

Model = Callable[[Any, int | None], np.ndarray]


def maze(model: Callable[[gymnasium.Env], Model]) -> ShieldWrapper:
    """Four rooms with open doors, one thing to go to, and time for the rule."""
    env = gymnasium.make(
        "BabyAI-GoToObjMazeOpen-v0",
        room_size=6,
        num_rows=2,
        num_cols=2,
        max_steps=120,
        disable_env_checker=True,
    )
    return shielded(env, RULE, logits=model(env))


def bot(env: gymnasium.Env) -> Model:
    """The bot as a model: it wants one action, and would rather do that than any other."""
    planner: list[BabyAIBot] = []

    def logits(observation: Any, executed: int | None) -> np.ndarray:
        if executed is None:
            planner[:] = [BabyAIBot(env)]
        wanted = np.zeros(7)
        wanted[planner[0].replan(executed)] = SURE
        return wanted

    return logits


def chance(env: gymnasium.Env) -> Model:
    """Any action, whatever is seen."""
    return lambda observation, executed: np.zeros(7)


def drive(env: ShieldWrapper, seed: int) -> tuple[str, bool]:
    """One episode: what became of the rule, and whether the mission was done."""
    random = np.random.default_rng(seed)
    _, info = env.reset(seed=seed)
    over = done = False
    while not over:
        action = random.choice(7, p=info["distribution"])
        _, reward, terminated, truncated, info = env.step(int(action))
        over, done = terminated or truncated, done or float(reward) > 0.0
    return info["verdict"].spec_status, done


def main() -> None:
    parser = argparse.ArgumentParser(description="A bot and a random model in a maze, kept inside a rule.")
    parser.add_argument("episodes", type=int, nargs="?", default=20, help="episodes of each (20)")
    episodes = parser.parse_args().episodes
    for name, model in (("the bot", bot), ("a model that draws at random", chance)):
        env = maze(model)
        ends, refused = [], 0  # in one maze of a hundred, a thing lies in front of the only door of a room
        for seed in range(episodes):
            try:
                ends.append(drive(env, seed))
            except InfeasibleStart:  # noqa: PERF203
                refused += 1
        kept, done = sum(end[0] == "satisfied" for end in ends), sum(end[1] for end in ends)
        print(f"{name}: the rule was kept in {kept} of {len(ends)} episodes, the mission done in {done}")
        if refused:
            print(f"{refused} mazes in which it cannot be kept were refused")


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    main()
