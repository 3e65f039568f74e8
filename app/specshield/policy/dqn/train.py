"""pi_phi by deep Q-learning on funnel-shaped rewards (paper, section IV-A); alone in importing torch.

Double DQN, n-step returns, Huber loss, Polyak-averaged target network, one update a step of all robots. The
robots step in a thread of their own while the network learns. Every figure in a card comes from the compiled
rollout that serves, not from torch.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.numpy import load_file, save_file
from scipy.stats import beta
from torch import nn

from specshield.policy.card import make_card
from specshield.policy.dqn.environment import Environment, free_poses
from specshield.policy.dqn.method import Settings
from specshield.policy.dqn.network import NAMES, Network, make_network
from specshield.policy.dqn.policy import Policy
from specshield.policy.dqn.rollout import satisfies
from specshield.policy.options import options_to_json
from specshield.robot.dynamics import motion_count
from specshield.task import Task


@dataclass(frozen=True)
class Progress:
    """A report from a running training. satisfied: the latest measured rate, None before the first."""

    update: int
    updates: int
    satisfied: float | None
    eta_s: float


class Stopped(Exception):
    """The training was told to stop."""


def train(
    task: Task,
    settings: Settings,
    seed: int,
    on_progress: Callable[[Progress], None] = lambda _: None,
    checkpoint: Path | None = None,
    should_stop: Callable[[], bool] = lambda: False,
    spec: dict[str, Any] | None = None,
) -> Policy:
    """Trains pi_phi and returns it with its card.

    checkpoint: a folder to save to at every evaluation and to resume from after a kill (the replay buffer is
    filled anew). Raises FragmentError for a formula outside the fragment, Stopped when `should_stop` says so.
    """
    # One core is the robots'; threads that wait for a core spin, at worst forty times slower than one thread.
    torch.set_num_threads(max((os.cpu_count() or 1) - 1, 1))
    run = _Run(task, settings, seed)
    if checkpoint is not None:
        run.resume(checkpoint)
    began, first = time.monotonic(), run.update
    with ThreadPoolExecutor(1) as stepper:
        while run.update < settings.updates:
            if should_stop():
                raise Stopped
            if not run.advance(stepper):
                continue
            if run.update % settings.evaluate_every == 0 or run.update == settings.updates:
                run.evaluate()
                if checkpoint is not None:
                    run.save(checkpoint)
            if run.update % 100 == 0 or run.update == settings.updates:
                pace = (time.monotonic() - began) / (run.update - first)
                left = pace * (settings.updates - run.update)
                on_progress(Progress(run.update, settings.updates, run.latest, left))
    metrics = measure(task, run.best, settings.evaluation_starts, seed)
    metrics["wall_time_s"] = round(run.elapsed + time.monotonic() - began, 1)
    card = make_card(task, "dqn", options_to_json(settings), seed, metrics, spec)
    return Policy(task, card, make_network(run.best, run.inputs, run.outputs))


def measure(task: Task, weights: dict[str, NDArray[np.float32]], starts: int, seed: int) -> dict[str, Any]:
    """How often pi_phi satisfies the formula from starts uniform over free space, t = 0.

    `satisfied`: pi_phi alone. `feasible_start`: some first action, then pi_phi (a session opens there). Each
    with its 95 % Clopper-Pearson interval.
    """
    env = Environment(task, 1, 0)
    poses = free_poses(task, env.body, starts, np.random.default_rng([seed, 1]))
    net = make_network(weights, env.observations.shape[1], motion_count(env.body))
    result: dict[str, Any] = {"starts": starts}
    for name, first in (("satisfied", False), ("feasible_start", True)):
        kept = satisfies(env.body, env.rules, env.sight, net, poses, first, task.robot.wait_motion)
        count = int(kept.sum())
        low = float(beta.ppf(0.025, count, starts - count + 1)) if count else 0.0
        high = float(beta.ppf(0.975, count + 1, starts - count)) if count < starts else 1.0
        result[name] = count / starts
        result[f"{name}_interval"] = [round(low, 4), round(high, 4)]
    return result


class _QNetwork(nn.Module):
    def __init__(self, inputs: int, units: int, outputs: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Linear(inputs, units), nn.ReLU(), nn.Linear(units, units), nn.ReLU(), nn.Linear(units, outputs)
        )

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        out: torch.Tensor = self.layers(x)
        return out

    def weights(self) -> dict[str, NDArray[np.float32]]:
        """In the serving layout: w [inputs, outputs]."""
        tensors = [p.detach().cpu().numpy() for p in self.parameters()]
        serving = [np.ascontiguousarray(t.T if t.ndim == 2 else t).copy() for t in tensors]
        return dict(zip(NAMES, serving, strict=True))

    def set_weights(self, weights: dict[str, NDArray[np.float32]]) -> None:
        with torch.no_grad():
            for name, parameter in zip(NAMES, self.parameters(), strict=True):
                array = weights[name]
                parameter.copy_(torch.from_numpy(np.ascontiguousarray(array.T if array.ndim == 2 else array)))


class _Replay:
    """The last steps of all robots, as rings [steps, robots, ...]."""

    def __init__(self, steps: int, robots: int, size: int) -> None:
        self.steps = steps
        self.observation = np.zeros((steps, robots, size), np.float32)
        self.motion = np.zeros((steps, robots), np.int64)
        self.reward = np.zeros((steps, robots), np.float32)
        self.ended = np.zeros((steps, robots), np.bool_)
        self.added = 0

    def add(
        self, observation: NDArray[np.float32], motion: NDArray[np.int64], reward: Any, ended: Any
    ) -> None:
        at = self.added % self.steps
        self.observation[at], self.motion[at] = observation, motion
        self.reward[at], self.ended[at] = reward, ended
        self.added += 1

    def sample(
        self, random: np.random.Generator, batch: int, n: int, discount: float
    ) -> tuple[NDArray[Any], ...]:
        """observation, motion, n-step return, bootstrap factor (0 after an end), observation n steps on."""
        held = min(self.added, self.steps)
        start = self.added - held + random.integers(0, held - n, batch)
        robot = random.integers(0, self.motion.shape[1], batch)
        returns, factor = np.zeros(batch, np.float32), np.ones(batch, np.float32)
        for j in range(n):
            at = (start + j) % self.steps
            returns += factor * self.reward[at, robot]
            factor *= np.float32(discount) * ~self.ended[at, robot]
        first, then = (start % self.steps, robot), ((start + n) % self.steps, robot)
        return self.observation[first], self.motion[first], returns, factor, self.observation[then]


class _Run:
    """One training run's state."""

    def __init__(self, task: Task, settings: Settings, seed: int) -> None:
        self.settings, self.task = settings, task
        self.device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
        self.env = Environment(task, settings.robots, seed, literal=settings.reward == "paper")
        self.random = np.random.default_rng([seed, 2])
        torch.manual_seed(seed)
        self.inputs, self.outputs = self.env.observations.shape[1], motion_count(self.env.body)
        self.q_network = _QNetwork(self.inputs, settings.units, self.outputs).to(self.device)
        self.target_network = _QNetwork(self.inputs, settings.units, self.outputs).to(self.device)
        self.target_network.load_state_dict(self.q_network.state_dict())
        self.optimizer = torch.optim.Adam(self.q_network.parameters(), lr=settings.learning_rate)
        low, high = sorted(settings.exploration)
        self.epsilon = np.geomspace(high, max(low, 1e-6), settings.robots)
        steps = max(settings.replay // settings.robots, 4 * settings.returns)
        self.replay = _Replay(steps, settings.robots, self.inputs)
        self.update, self.elapsed, self.latest, self.best_rate = 0, 0.0, None, -1.0
        self.best = self.q_network.weights()
        self.began = time.monotonic()

    update: int
    elapsed: float
    latest: float | None

    def advance(self, stepper: ThreadPoolExecutor) -> bool:
        """All robots step while the network learns from what was before; whether that was enough to learn."""
        observation = self.env.observations.copy()
        with torch.no_grad():
            motion = self.q_network(torch.from_numpy(observation).to(self.device)).argmax(1).cpu().numpy()
        explore = self.random.random(len(motion)) < self.epsilon
        motion[explore] = self.random.integers(0, self.outputs, int(explore.sum()))
        stepping = stepper.submit(self.env.step, motion)
        learns = self.replay.added >= 4 * self.settings.returns + 20
        if learns:
            self._learn()
            self.update += 1
        reward, ended = stepping.result()
        self.replay.add(observation, motion, reward, ended)
        return learns

    def _learn(self) -> None:
        s = self.settings
        batch = self.replay.sample(self.random, s.batch, s.returns, s.discount)
        observation, motion, returns, factor, then = (torch.from_numpy(a).to(self.device) for a in batch)
        for group in self.optimizer.param_groups:
            group["lr"] = s.learning_rate * max(1.0 - self.update / s.updates, 0.02)
        with torch.no_grad():
            choice = self.q_network(then).argmax(1, keepdim=True)
            goal = returns + factor * self.target_network(then).gather(1, choice).squeeze(1)
            # One step's delay is worth little beside a whole episode, less than the network's error: without
            # a wider gap between actions (Bellemare et al., 2016) the greedy policy dithers.
            now = self.target_network(observation)
            goal -= s.gap * (now.max(1).values - now.gather(1, motion.unsqueeze(1)).squeeze(1))
        value = self.q_network(observation).gather(1, motion.unsqueeze(1)).squeeze(1)
        loss = nn.functional.smooth_l1_loss(value, goal)
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        self.optimizer.step()
        with torch.no_grad():
            for slow, fast in zip(self.target_network.parameters(), self.q_network.parameters(), strict=True):
                slow.lerp_(fast, s.polyak)

    def evaluate(self) -> None:
        """Keeps the weights that satisfy most often, measured on starts of their own."""
        weights = self.q_network.weights()
        net: Network = make_network(weights, self.inputs, self.outputs)
        env, wait = self.env, self.task.robot.wait_motion
        poses = free_poses(self.task, env.body, self.settings.evaluation_starts, np.random.default_rng(0))
        rate = float(satisfies(env.body, env.rules, env.sight, net, poses, False, wait).mean())
        self.latest = rate
        if rate >= self.best_rate:
            self.best_rate, self.best = rate, weights

    def save(self, folder: Path) -> None:
        """Atomically: a kill leaves the checkpoint before."""
        folder.mkdir(parents=True, exist_ok=True)
        arrays = {f"q.{n}": a for n, a in self.q_network.weights().items()}
        arrays |= {f"target.{n}": a for n, a in self.target_network.weights().items()}
        arrays |= {f"best.{n}": a for n, a in self.best.items()}
        for i, parameter in enumerate(self.q_network.parameters()):
            state = self.optimizer.state[parameter]
            for name in ("exp_avg", "exp_avg_sq", "step"):
                arrays[f"adam.{i}.{name}"] = state[name].detach().cpu().numpy().reshape(-1)
        meta = {
            "task": self.task.content_hash, "settings": options_to_json(self.settings), "update": self.update,
            "elapsed": self.elapsed + time.monotonic() - self.began, "latest": self.latest,
            "best_rate": self.best_rate, "random": self.random.bit_generator.state,
        }  # fmt: skip
        save_file(arrays, folder / "state.tmp", metadata={"meta": json.dumps(meta)})
        os.replace(folder / "state.tmp", folder / "state.safetensors")

    def resume(self, folder: Path) -> None:
        """Takes up a checkpoint of the same task and settings; any other is ignored."""
        from safetensors import safe_open

        path = folder / "state.safetensors"
        if not path.exists():
            return
        with safe_open(path, framework="numpy") as opened:
            meta = json.loads(opened.metadata()["meta"])
        if (meta["task"], meta["settings"]) != (self.task.content_hash, options_to_json(self.settings)):
            return
        arrays = load_file(path)
        self.q_network.set_weights({n: arrays[f"q.{n}"] for n in NAMES})
        self.target_network.set_weights({n: arrays[f"target.{n}"] for n in NAMES})
        self.best = {n: arrays[f"best.{n}"] for n in NAMES}
        for i, parameter in enumerate(self.q_network.parameters()):
            self.optimizer.state[parameter] = {
                "step": torch.tensor(float(arrays[f"adam.{i}.step"][0])),
                **{n: torch.from_numpy(arrays[f"adam.{i}.{n}"]).reshape(parameter.shape).to(self.device)
                   for n in ("exp_avg", "exp_avg_sq")},
            }  # fmt: skip
        self.random.bit_generator.state = meta["random"]
        self.update, self.elapsed = meta["update"], meta["elapsed"]
        self.latest, self.best_rate = meta["latest"], meta["best_rate"]
