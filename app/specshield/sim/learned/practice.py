"""Many robots at once that practise finding targets in apartments: what they sense, and what the expert says.

In every other episode the robot is interfered with, as a shield would: held where it is, or steered towards
something else for tens of steps, or its actions fail at random. The expert says what to do from where it is.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from specshield.compiled import kernel
from specshield.robot import STRETCH
from specshield.robot.unicycle import Body, in_collision, make_body, step
from specshield.sim.learned.expert import END, END_WITHIN, IDLE, advise, ways
from specshield.sim.learned.floor_plans import House
from specshield.sim.learned.network import ACTIONS, INPUTS, KINDS, NOTHING
from specshield.sim.senses import RAYS, scan, see


class Apartments:
    """Houses as the compiled loop takes them, padded to one size; a target that a house lacks is NaN."""

    def __init__(self, houses: Sequence[House]) -> None:
        side = max(max(house.grid.occupied.shape) for house in houses)
        n, k = len(houses), len(KINDS)
        self.occupied = np.ones((n, side, side), np.uint8)
        self.clearance = np.zeros((n, side, side))
        self.to_go = np.full((n, k, side, side), 1e6, np.float32)
        self.targets = np.full((n, k, 2), np.nan)
        for i, house in enumerate(houses):
            h, w = house.grid.occupied.shape
            self.occupied[i, :h, :w], self.clearance[i, :h, :w] = house.grid.occupied, house.grid.clearance
            held = [KINDS.index(name) for name in house.targets]
            self.targets[i, held] = list(house.targets.values())
            self.to_go[i, held, :h, :w] = ways(house.grid, list(house.targets.values()))
        self.body = make_body(STRETCH, houses[0].grid)

    def __len__(self) -> int:
        return len(self.occupied)


class Practice:
    """`robots` robots, each with an apartment, a target and a start drawn anew at `reset`.

    senses [N, INPUTS] float32: ranges and distance [m], seen, bearing [rad]. last [N]: the action executed
    last. advice [N, A]: the expert's distribution. kind [N]: what each looks for. done [N]: it ended there.
    """

    def __init__(self, apartments: Apartments, robots: int, random: np.random.Generator) -> None:
        self.apartments, self.random = apartments, random
        self.pose = np.zeros((robots, 3))
        self.senses = np.zeros((robots, INPUTS), np.float32)
        self.advice = np.zeros((robots, ACTIONS), np.float32)
        self.detour = np.zeros((robots, ACTIONS), np.float32)

    def reset(self, chances: Sequence[float]) -> None:
        """chances (K,): of each kind of target."""
        n, random, targets = len(self.pose), self.random, self.apartments.targets
        self.house = random.integers(0, len(self.apartments), n)
        there = ~np.isnan(targets[self.house, :, 0])
        wish = np.log(np.asarray(chances)) + random.gumbel(size=there.shape)
        order = np.argsort(np.where(there, -wish, np.inf), axis=1)
        self.kind, self.other = order[:, 0], order[:, 1]
        self.last = np.full(n, NOTHING)
        self.done = np.zeros(n, np.bool_)
        self.t = 0
        side = self.apartments.occupied.shape[1] * self.apartments.body.resolution
        draws = random.random((n, 400, 3)) * (side, side, 2 * math.pi) - (0.0, 0.0, math.pi)
        _place(
            self.apartments.body,
            self.apartments.occupied,
            self.apartments.clearance,
            self.house,
            draws,
            self.pose,
        )
        # In two spells, from step `begin` for `length` steps, held or steered; slips at a constant chance.
        kinds = random.choice(3, n, p=[0.4, 0.1, 0.5])
        self.held, self.steered = kinds == 1, kinds == 2
        self.begin = random.integers(0, 40, n) + np.array([[0], [80]])
        self.length = random.integers(5, 60, (2, n))
        self.slips = random.choice([0.0, 0.03, 0.15], n, p=[0.5, 0.3, 0.2])
        self._look()

    def execute(self, actions: NDArray[np.int64]) -> None:
        """Each robot's wish (N,), where nothing interferes; an `end` counts where the expert ends too."""
        random, n = self.random, len(actions)
        during = ((self.t >= self.begin) & (self.t < self.begin + self.length)).any(axis=0)
        ended = (actions == END) & (self.advice[:, END] > 0.5) & ~(during & (self.held | self.steered))
        executed = np.where(actions == END, IDLE, actions)
        executed = np.where(during & self.steered, sample(self.detour, random), executed)
        executed = np.where(during & self.held, IDLE, executed)
        slip = random.random(n) < self.slips
        executed = np.where(slip, random.choice(STRETCH.representative, n), executed)
        self.done |= ended
        self.last = np.where(self.done, self.last, executed)
        motions = STRETCH.motion_of[np.where(self.done, IDLE, executed)]
        _move(
            self.apartments.body,
            self.apartments.occupied,
            self.apartments.clearance,
            self.house,
            motions,
            self.pose,
        )
        self.t += 1
        self._look()

    def _look(self) -> None:
        a = self.apartments
        _look(
            a.body, a.occupied, a.clearance, a.to_go, a.targets, STRETCH.representative, self.house,
            self.kind, self.other, self.pose, self.senses, self.advice, self.detour,
        )  # fmt: skip


def sample(distributions: NDArray[np.float32], random: np.random.Generator) -> NDArray[np.int64]:
    """One index a row. distributions [N, A]."""
    total = np.cumsum(distributions.astype(np.float64), axis=1)
    drawn: NDArray[np.int64] = (random.random((len(total), 1)) * total[:, -1:] > total).sum(axis=1)
    return drawn


@kernel
def _body(body: Body, occupied: NDArray[np.uint8], clearance: NDArray[np.float64]) -> Body:
    """The robot in another apartment, whose corner is the origin."""
    return Body(
        occupied, clearance, body.resolution, 0.0, 0.0, 1.0, 0.0, body.radius, body.offset_x, body.offset_y,
        body.stop, body.translate, body.rotate,
    )  # fmt: skip


@kernel
def _place(
    body: Body,
    occupied: NDArray[np.uint8],
    clearance: NDArray[np.float64],
    house: NDArray[np.int64],
    draws: NDArray[np.float64],
    pose: NDArray[np.float64],
) -> None:
    """The first of the draws [N, D, 3] that is not in collision; the last one where all are."""
    for n in range(pose.shape[0]):
        own = _body(body, occupied[house[n]], clearance[house[n]])
        for d in range(draws.shape[1]):
            pose[n] = draws[n, d]
            if not in_collision(own, pose[n, 0], pose[n, 1], pose[n, 2]):
                break


@kernel
def _move(
    body: Body,
    occupied: NDArray[np.uint8],
    clearance: NDArray[np.float64],
    house: NDArray[np.int64],
    motions: NDArray[np.int64],
    pose: NDArray[np.float64],
) -> None:
    for n in range(pose.shape[0]):
        own = _body(body, occupied[house[n]], clearance[house[n]])
        pose[n, 0], pose[n, 1], pose[n, 2] = step(own, pose[n, 0], pose[n, 1], pose[n, 2], motions[n])


@kernel
def _look(
    body: Body,
    occupied: NDArray[np.uint8],
    clearance: NDArray[np.float64],
    to_go: NDArray[np.float32],
    targets: NDArray[np.float64],
    representative: NDArray[np.int64],
    house: NDArray[np.int64],
    kind: NDArray[np.int64],
    other: NDArray[np.int64],
    pose: NDArray[np.float64],
    senses: NDArray[np.float32],
    advice: NDArray[np.float32],
    detour: NDArray[np.float32],
) -> None:
    ranges = np.empty(RAYS)
    for n in range(pose.shape[0]):
        i, x, y, theta = house[n], pose[n, 0], pose[n, 1], pose[n, 2]
        own = _body(body, occupied[i], clearance[i])
        scan(own, x, y, theta, ranges)
        senses[n, :RAYS] = ranges
        seen, distance, bearing = see(own, x, y, theta, targets[i, kind[n], 0], targets[i, kind[n], 1])
        senses[n, RAYS], senses[n, RAYS + 1], senses[n, RAYS + 2] = 1.0 if seen else 0.0, distance, bearing
        near = seen and distance < END_WITHIN
        advise(own, representative, to_go[i, kind[n]], x, y, theta, near, advice[n])
        advise(own, representative, to_go[i, other[n]], x, y, theta, False, detour[n])
