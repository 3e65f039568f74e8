"""What it costs to make a policy: reachability, our DQN, stable-baselines3's DQN on the same environment."""

from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np

from benchmarks.houses import RESTLESS
from benchmarks.states import shipped_dqn
from benchmarks.timing import quietest
from specshield.policy.dqn.environment import Environment, free_poses
from specshield.policy.dqn.method import Settings
from specshield.policy.dqn.network import NAMES, make_network
from specshield.policy.dqn.rollout import satisfies
from specshield.policy.reachability import policy as reachability
from specshield.policy.reachability.policy import load_reachability
from specshield.sim.cases import Case, load_case

STARTS = 1000
EVERY = 10_000  # steps of stable-baselines3 between two measurements


def reach(case_name: str, repeats: int) -> dict[str, Any]:
    """Seconds to make the tables and to load them, their size, the same for a robot that cannot wait, and the
    shipped DQN's card beside them.
    """
    case = load_case(case_name)
    reachability.synthesise(case.task)  # compiles, or loads what is compiled
    seconds = quietest(lambda: reachability.synthesise(case.task), repeats)
    policy = reachability.synthesise(case.task)
    weights = policy.weights()
    card = shipped_dqn(case).card
    stepwise = reachability.synthesise(replace(case.task, robot=RESTLESS))
    return {
        "synthesis_s": seconds,
        "load_s": quietest(lambda: load_reachability(weights, policy.card, case.task), repeats),
        "size_bytes": len(weights),
        "stepwise_s": stepwise.card["metrics"]["wall_time_s"],
        "stepwise_bytes": len(stepwise.weights()),
        "feasible_start": policy.card["metrics"]["feasible_start"],
        "dqn": {"updates": card["options"]["updates"], **card["metrics"]},
    }


def race(case_name: str, rate: float, minutes: float, seed: int) -> dict[str, Any]:
    """Our DQN and stable-baselines3's, each until pi_phi satisfies from `rate` of the starts or time is up.

    Each gives its curve, [seconds, rate]; measuring is left out of stable-baselines3's seconds, not of ours.
    """
    case = load_case(case_name)
    ours, theirs = _ours(case, rate, minutes, seed), _sb3(case, rate, minutes, seed)
    result = {"case": case_name, "rate": rate, "minutes": minutes, "seed": seed}
    return result | {"specshield DQN": ours, "stable-baselines3 DQN": theirs}


def _ours(case: Case, rate: float, minutes: float, seed: int) -> list[list[float]]:
    from specshield.policy.dqn.train import Training

    curve: list[list[float]] = []
    began, settings = time.perf_counter(), replace(Settings(), evaluation_starts=STARTS)
    training = Training(case.task, settings, seed)
    with ThreadPoolExecutor(1) as stepper:
        while training.update < settings.updates and time.perf_counter() - began <= 60 * minutes:
            if training.advance(stepper) and training.update % 500 == 0:
                training.evaluate()
                curve.append([time.perf_counter() - began, float(training.latest or 0.0)])
                if _enough(curve, rate):
                    break
    return curve


def _sb3(case: Case, rate: float, minutes: float, seed: int) -> list[list[float]]:
    """Its defaults, with our network's size, discount and learning rate, one gymnasium robot."""
    import gymnasium
    from stable_baselines3 import DQN
    from stable_baselines3.common.callbacks import BaseCallback

    practice = Environment(case.task, 1, seed)
    inputs, outputs = practice.robots.observation.shape[1], len(case.task.robot.motions)

    class Practice(gymnasium.Env[np.ndarray, np.int64]):
        observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (inputs,), np.float32)
        action_space = gymnasium.spaces.Discrete(outputs)

        def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
            return practice.robots.observation[0].copy(), {}  # an episode that ends begins anew at once

        def step(self, action: np.int64) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
            rewards, ended = practice.step(np.array([action]))
            return practice.robots.observation[0].copy(), float(rewards[0]), bool(ended[0]), False, {}

    poses = free_poses(case.task, practice.scene.body, STARTS, np.random.default_rng(0))
    curve: list[list[float]] = []
    began, measuring = time.perf_counter(), 0.0

    class Watch(BaseCallback):
        def _on_step(self) -> bool:
            nonlocal measuring
            now = time.perf_counter()
            spent = now - began - measuring
            last = spent >= 60 * minutes
            if last or self.num_timesteps % EVERY == 0:
                curve.append([spent, measure()])
                measuring += time.perf_counter() - now
            return not (last or _enough(curve, rate))

    def measure() -> float:
        tensors = [p.detach().cpu().numpy() for p in model.q_net.parameters()]
        weights = {n: np.ascontiguousarray(t.T) for n, t in zip(NAMES, tensors, strict=True)}
        net = make_network(weights, inputs, outputs)
        return float(satisfies(practice.scene, net, poses, False).mean())

    ours = Settings()
    model = DQN(
        "MlpPolicy", Practice(), learning_rate=ours.learning_rate, gamma=ours.discount, seed=seed,
        policy_kwargs={"net_arch": [ours.units, ours.units]},
    )  # fmt: skip
    model.learn(2_000_000, callback=Watch())
    return curve


def _enough(curve: list[list[float]], rate: float) -> bool:
    return bool(curve) and curve[-1][1] >= rate
