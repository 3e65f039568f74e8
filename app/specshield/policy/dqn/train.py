"""pi_phi by deep Q-learning on funnel-shaped rewards (paper, section IV-A). Only this module imports torch.

Double DQN (van Hasselt et al., 2016), n-step returns, Huber loss, Polyak-averaged target network, one update
for each step of all robots. The robots step in a thread of their own while the network learns. Every figure
in a card comes from the compiled rollout that the service runs, not from torch.
"""

from __future__ import annotations

import json
import os
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from scipy.special import betaincinv  # scipy.stats has the interval, and takes 0.5 s more to import
from torch import nn

from specshield.arrays import Bools, Ints, Singles
from specshield.cores import cores
from specshield.policy.card import make_card
from specshield.policy.dqn.environment import Environment, free_poses
from specshield.policy.dqn.method import Settings
from specshield.policy.dqn.network import NAMES, make_network
from specshield.policy.dqn.policy import Policy
from specshield.policy.dqn.rollout import satisfies
from specshield.policy.dqn.scene import make_scene
from specshield.policy.methods import Run
from specshield.policy.options import options_to_json
from specshield.task import Task

# Chosen by hand; nothing was measured.
WARM_UP = 20  # steps of all robots before the first update, beside four times an n-step return
LEAST_RATE = 0.02  # share of the learning rate that it falls to, linearly, by the last update
REPORT_EVERY = 100  # updates


def train(task: Task, settings: Settings, run: Run) -> Policy:
    """Trains pi_phi and returns it with its card.

    It saves to `run.checkpoints` at every evaluation, and resumes from there after a kill; the replay buffer
    is not saved but filled anew. Raises FragmentError for a formula outside the fragment.
    """
    training = Training(task, settings, run.seed)
    if run.checkpoints is not None:
        training.resume(run.checkpoints)
    began, first = time.monotonic(), training.update
    with ThreadPoolExecutor(1) as stepper:
        while training.update < settings.updates:
            if not training.advance(stepper):
                continue
            last = training.update == settings.updates
            if last or training.update % settings.evaluate_every == 0:
                training.evaluate()
                if run.checkpoints is not None:
                    training.save(run.checkpoints)
            if last or training.update % REPORT_EVERY == 0:
                pace = (time.monotonic() - began) / (training.update - first)
                left = pace * (settings.updates - training.update)
                rate = "not measured yet" if training.latest is None else f"satisfied {training.latest:.1%}"
                said = f"update {training.update} of {settings.updates}, {rate}"
                run.on_progress(training.update / settings.updates, left, said)
    weights = weights_of(training.best)
    metrics = measure(task, weights, settings.evaluation_starts, run.seed)
    metrics["wall_time_s"] = round(time.monotonic() - training.began, 1)
    card = make_card(task, "dqn", options_to_json(settings), run.seed, metrics, run.spec)
    return Policy(task, card, make_network(weights, training.inputs, training.outputs))


def measure(task: Task, weights: dict[str, Singles], starts: int, seed: int) -> dict[str, Any]:
    """How often pi_phi satisfies the formula from starts uniform over free space, t = 0.

    `satisfied`: pi_phi alone. `feasible_start`: some first action, then pi_phi, which is where a session can
    open. Each with its 95 % interval (Clopper and Pearson, 1934).
    """
    scene = make_scene(task)
    poses = free_poses(task, scene.body, starts, np.random.default_rng([seed, 1]))
    net = make_network(weights, len(weights["w1"]), len(task.robot.motions))
    result: dict[str, Any] = {"starts": starts}
    for name, first in (("satisfied", False), ("feasible_start", True)):
        count = int(satisfies(scene, net, poses, first).sum())
        low = betaincinv(count, starts - count + 1, 0.025) if count > 0 else 0.0
        high = betaincinv(count + 1, starts - count, 0.975) if count < starts else 1.0
        result |= {name: count / starts, f"{name}_interval": [round(float(low), 4), round(float(high), 4)]}
    return result


def make_q_network(inputs: int, units: int, outputs: int) -> nn.Sequential:
    """The network of network.py, for torch."""
    hidden = (nn.Linear(inputs, units), nn.ReLU(), nn.Linear(units, units), nn.ReLU())
    return nn.Sequential(*hidden, nn.Linear(units, outputs))


def weights_of(network: nn.Module) -> dict[str, Singles]:
    """A copy of the weights in the form of network.py: w [inputs, outputs]."""
    arrays = [parameter.detach().cpu().numpy().T.copy() for parameter in network.parameters()]
    return dict(zip(NAMES, arrays, strict=True))


class Replay:
    """The last steps of all robots, as rings [steps, robots, ...]."""

    def __init__(self, steps: int, robots: int, inputs: int) -> None:
        self.steps = steps
        self.observation = np.zeros((steps, robots, inputs), np.float32)
        self.motion = np.zeros((steps, robots), np.int64)
        self.reward = np.zeros((steps, robots), np.float32)
        self.ended = np.zeros((steps, robots), np.bool_)
        self.added = 0

    def add(self, observation: Singles, motion: Ints, reward: Singles, ended: Bools) -> None:
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


class Training:
    """The robots, the networks, and how far it is."""

    def __init__(self, task: Task, settings: Settings, seed: int) -> None:
        self.task, self.settings, self.seed = task, settings, seed
        self.device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
        self.environment = Environment(task, settings.robots, seed, literal=settings.reward == "paper")
        self.inputs, self.outputs = self.environment.robots.observation.shape[1], len(task.robot.motions)
        self.random = np.random.default_rng([seed, 2])
        # One core is for the robots. A thread that waits for a core spins: forty times slower at worst.
        torch.set_num_threads(max(cores() - 1, 1))
        torch.manual_seed(seed)
        self.q_network, self.target_network, self.best = (
            make_q_network(self.inputs, settings.units, self.outputs).to(self.device) for _ in range(3)
        )
        for other in (self.target_network, self.best):
            other.load_state_dict(self.q_network.state_dict())
        self.optimizer = torch.optim.Adam(self.q_network.parameters(), lr=settings.learning_rate)
        low, high = np.maximum(sorted(settings.exploration), 1e-6)
        self.epsilon = np.geomspace(high, low, settings.robots)  # each robot has its own
        steps = max(settings.replay // settings.robots, 4 * settings.returns)
        self.replay = Replay(steps, settings.robots, self.inputs)
        self.update = 0
        self.latest: float | None = None  # the rate measured last
        self.best_rate = -1.0
        self.began = time.monotonic()

    def advance(self, stepper: ThreadPoolExecutor) -> bool:
        """All robots step while the network learns from earlier steps. False while those are too few."""
        observation = self.environment.robots.observation.copy()
        with torch.no_grad():
            motion = self.q_network(torch.from_numpy(observation).to(self.device)).argmax(1).cpu().numpy()
        explore = self.random.random(len(motion)) < self.epsilon
        motion[explore] = self.random.integers(0, self.outputs, int(explore.sum()))
        stepping = stepper.submit(self.environment.step, motion)
        learns = self.replay.added >= 4 * self.settings.returns + WARM_UP
        if learns:
            self._learn()
            self.update += 1
        self.replay.add(observation, motion, *stepping.result())
        return learns

    def _learn(self) -> None:
        s = self.settings
        batch = self.replay.sample(self.random, s.batch, s.returns, s.discount)
        observation, motion, returns, factor, then = (torch.from_numpy(a).to(self.device) for a in batch)
        for group in self.optimizer.param_groups:
            group["lr"] = s.learning_rate * max(1.0 - self.update / s.updates, LEAST_RATE)
        with torch.no_grad():
            choice = self.q_network(then).argmax(1, keepdim=True)
            goal = returns + factor * self.target_network(then).gather(1, choice).squeeze(1)
            # A step's delay costs little of an episode's return, less than the network's error. Without a
            # wider gap between the actions' values (Bellemare et al., 2016) the greedy policy dithers.
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
        """Measures the rate on starts of its own, always the same, and keeps the best network."""
        scene = self.environment.scene
        net = make_network(weights_of(self.q_network), self.inputs, self.outputs)
        starts = free_poses(self.task, scene.body, self.settings.evaluation_starts, np.random.default_rng(0))
        self.latest = float(satisfies(scene, net, starts, False).mean())
        if self.latest >= self.best_rate:
            self.best_rate = self.latest
            self.best.load_state_dict(self.q_network.state_dict())

    @property
    def _networks(self) -> dict[str, nn.Module]:
        return {"q": self.q_network, "target": self.target_network, "best": self.best}

    @property
    def _of(self) -> dict[str, Any]:
        """What a checkpoint is of, as JSON."""
        settings = options_to_json(self.settings)
        return {"task": self.task.content_hash, "settings": settings, "seed": self.seed}

    def save(self, folder: Path) -> None:
        """Writes the checkpoint at once: a kill meanwhile leaves the one before."""
        folder.mkdir(parents=True, exist_ok=True)
        parts = {name: network.state_dict() for name, network in self._networks.items()}
        parts |= {f"adam{i}": state for i, state in self.optimizer.state_dict()["state"].items()}
        tensors = {f"{part} {name}": tensor for part in parts for name, tensor in parts[part].items()}
        meta = {
            **self._of,
            "update": self.update,
            "elapsed": time.monotonic() - self.began,
            "latest": self.latest,
            "best_rate": self.best_rate,
            "random": self.random.bit_generator.state,
        }
        save_file(tensors, folder / "state.tmp", metadata={"meta": json.dumps(meta)})
        os.replace(folder / "state.tmp", folder / "state.safetensors")

    def resume(self, folder: Path) -> None:
        """Goes on from a checkpoint of the same task, settings and seed; any other is ignored, and so is one
        that a loss of power has damaged.
        """
        path = folder / "state.safetensors"
        if not path.exists():
            return
        parts: dict[str, dict[str, torch.Tensor]] = {}
        try:
            with safe_open(path, framework="pt") as opened:
                meta = json.loads(opened.metadata()["meta"])
                if {name: meta.get(name) for name in self._of} != self._of:
                    return
                for key in opened.keys():  # noqa: SIM118 (not a dict)
                    part, name = key.split()
                    parts.setdefault(part, {})[name] = opened.get_tensor(key)
        except SafetensorError:
            return
        for part, network in self._networks.items():
            network.load_state_dict(parts[part])
        moments = {int(part[4:]): parts[part] for part in parts if part.startswith("adam")}
        groups = self.optimizer.state_dict()["param_groups"]
        self.optimizer.load_state_dict({"state": moments, "param_groups": groups})
        self.random.bit_generator.state = meta["random"]
        self.update, self.latest, self.best_rate = meta["update"], meta["latest"], meta["best_rate"]
        self.began -= meta["elapsed"]
