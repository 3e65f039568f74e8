"""Many robots at once practise finding targets in apartments: what they sense, and what the expert says.

The expert takes shortest paths: to the target once the robot has seen it; before, to the nearest room that
has been in sight but not been looked at yet, rather one ahead than one behind. What it says follows from what
the robot has seen, so it can be imitated by one that has no map.

With interference, half of the episodes are disturbed as a shield would do it: the robot is held where it is,
or steered towards something else, in two spells of tens of steps. In half of them its actions also fail at
random. The expert says what to do from where the robot then is. What is measured with this model under a
shield is therefore measured with one that has practised being steered. Without interference the robot
executes what the expert or the network chose, and nothing else.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evaluation.apartments import Box
from evaluation.model.expert import END, END_WITHIN, IDLE, OFF, advise, bearing_of_way, ways
from evaluation.model.floor_plans import House
from specshield.compiled import kernel, leaf
from specshield.robot import STRETCH
from specshield.robot.dynamics import Body, in_collision, make_body, step
from specshield.sim.learned.network import ACTIONS, INPUTS, KINDS, NOTHING
from specshield.sim.senses import FIELD_OF_VIEW, RAYS, SIGHT, cast, scan, see
from specshield.world.occupancy import OccupancyGrid

ROOMS = 8  # of a house, at most
PATCH = 5  # [cells] side of the squares in which is kept what has been looked at
LOOKED_AT = 0.7  # share of a room's floor after which it counts as looked at
THERE = 0.35  # [m] from a room's middle; nearer than this, the expert turns and looks
UNNOTICED = 100.0  # [m] longer than any way: rooms of which nothing has been in sight come last
STAY = 0.5  # [m] by which another room has to be nearer than the one chosen before
TURN = 1.5  # [m] that a turn of one radian counts, so that the expert rather goes on ahead


class Apartments(NamedTuple):
    """H houses as the compiled loop takes them, padded to one size; a target that a house lacks is NaN.

    body: the robot; its own map is not used. ways [H, KINDS + ROOMS, side, side]: metres to go to each target
    and to each room's middle. targets [H, KINDS, 2]. home [H, KINDS]: each target's room. room_of [H, P, P]:
    of each patch of floor, -1 for none. floor [H, ROOMS]: patches of each room, 0 for no room.
    """

    body: Body
    occupied: NDArray[np.uint8]
    clearance: NDArray[np.float64]
    ways: NDArray[np.float32]
    targets: NDArray[np.float64]
    home: NDArray[np.int64]
    room_of: NDArray[np.int8]
    floor: NDArray[np.int64]


def make_apartments(houses: Sequence[House]) -> Apartments:
    side = PATCH * math.ceil(max(max(house.grid.occupied.shape) for house in houses) / PATCH)
    n, k = len(houses), len(KINDS)
    a = Apartments(
        make_body(STRETCH, houses[0].grid), np.ones((n, side, side), np.uint8), np.zeros((n, side, side)),
        np.full((n, k + ROOMS, side, side), 1e6, np.float32), np.full((n, k, 2), np.nan),
        np.zeros((n, k), np.int64), np.full((n, side // PATCH, side // PATCH), -1, np.int8),
        np.zeros((n, ROOMS), np.int64),
    )  # fmt: skip
    for i, house in enumerate(houses):
        h, w = house.grid.occupied.shape
        a.occupied[i, :h, :w], a.clearance[i, :h, :w] = house.grid.occupied, house.grid.clearance
        held = [KINDS.index(name) for name in house.targets]
        points = list(house.targets.values())
        a.targets[i, held] = points
        rooms = house.rooms[:ROOMS]
        a.home[i, held] = [[_inside(room, x, y) for room in rooms].index(True) for x, y in points]
        middles = [_middle(house.grid, room) for room in rooms]
        a.ways[i, held + [k + r for r in range(len(rooms))], :h, :w] = ways(house.grid, points + middles)
        free = ~a.occupied[i].astype(bool).reshape(side // PATCH, PATCH, -1, PATCH).any(axis=(1, 3))
        for r, room in enumerate(rooms):
            x0, y0, x1, y1 = (round(v / (PATCH * house.grid.resolution)) for v in room)
            own = a.room_of[i, y0:y1, x0:x1]
            own[free[y0:y1, x0:x1]] = r
        a.floor[i] = [(a.room_of[i] == r).sum() for r in range(ROOMS)]
    return a


def _inside(room: Box, x: float, y: float) -> bool:
    return room[0] <= x <= room[2] and room[1] <= y <= room[3]


def _middle(grid: OccupancyGrid, room: Box) -> tuple[float, float]:
    """Where in a room there is most space, nearest its centre."""
    x, y = grid.centres[..., 0], grid.centres[..., 1]
    inside = (x > room[0]) & (x < room[2]) & (y > room[1]) & (y < room[3])
    away = np.hypot(x - 0.5 * (room[0] + room[2]), y - 0.5 * (room[1] + room[3]))
    best = np.argmax(np.where(inside, np.minimum(grid.clearance, 0.7) - 0.2 * away, -np.inf))
    return float(x.flat[best]), float(y.flat[best])


class Practice:
    """`robots` robots, each with an apartment, a target and a start drawn anew at `reset`.

    senses [N, INPUTS] float32: ranges and distance [m], seen, bearing [rad]. last [N]: the action executed
    last. advice [N, A]: the expert's distribution. kind [N]: what each looks for. done [N]: it ended there.
    """

    def __init__(
        self,
        apartments: Apartments,
        robots: int,
        random: np.random.Generator,
        weight: NDArray[np.float64] | None = None,
        interference: bool = True,
    ) -> None:
        """weight (H,): the chance of each apartment; by default all are alike."""
        self.apartments, self.random, self.weight = apartments, random, weight
        self.interference = interference
        patches = apartments.room_of.shape[1]
        self.pose = np.zeros((robots, 3))
        self.senses = np.zeros((robots, INPUTS), np.float32)
        self.advice = np.zeros((robots, ACTIONS), np.float32)
        self.detour = np.zeros((robots, ACTIONS), np.float32)
        self.looked_at = np.zeros((robots, patches, patches), np.uint8)
        self.noticed = np.zeros((robots, ROOMS), np.uint8)  # a part of the room has been in sight
        self.goal = np.zeros(robots, np.int64)  # an index into `ways`

    def reset(self, chances: Sequence[float]) -> None:
        """chances (K,): of each kind of target."""
        n, random, a = len(self.pose), self.random, self.apartments
        self.house = random.choice(len(a.occupied), n, p=self.weight)
        there = ~np.isnan(a.targets[self.house, :, 0])
        wish = np.log(np.asarray(chances)) + random.gumbel(size=there.shape)
        self.kind = np.where(there, wish, -np.inf).argmax(axis=1)
        rooms = np.where(a.floor[self.house] > 0, random.random((n, ROOMS)), -1.0)
        self.other = len(KINDS) + rooms.argmax(axis=1)
        self.last = np.full(n, NOTHING)
        self.done = np.zeros(n, np.bool_)
        self.t = 0
        side = a.occupied.shape[1] * a.body.resolution
        draws = random.random((n, 400, 3)) * (side, side, 2 * math.pi) - (0.0, 0.0, math.pi)
        _place(a, self.house, draws, self.pose)
        # In two spells, from step `begin` for `length` steps, held or steered; slips at a constant chance.
        left_alone = [1.0, 0.0, 0.0]  # the same draws are made, so that both kinds of training see one world
        kinds = random.choice(3, n, p=[0.5, 0.1, 0.4] if self.interference else left_alone)
        self.held, self.steered = kinds == 1, kinds == 2
        self.begin = random.integers(0, 40, n) + np.array([[0], [80]])
        self.length = random.integers(5, 80, (2, n))
        self.slips = random.choice(
            [0.0, 0.03, 0.15], n, p=[0.5, 0.3, 0.2] if self.interference else left_alone
        )
        self.looked_at[:] = 0
        self.noticed[:] = 0
        self.goal[:] = -1
        self._look()

    def execute(self, actions: NDArray[np.int64]) -> None:
        """Each robot's wish (N,), where nothing interferes; an `end` counts where the expert ends too."""
        random, n = self.random, len(actions)
        during = self.interfered
        ended = (actions == END) & (self.advice[:, END] > 0.5) & ~during
        executed = np.where(actions == END, IDLE, actions)
        executed = np.where(during & self.steered, sample(self.detour, random), executed)
        executed = np.where(during & self.held, IDLE, executed)
        slip = random.random(n) < self.slips
        executed = np.where(slip, random.choice(STRETCH.representative, n), executed)
        self.done |= ended
        self.last = np.where(self.done, self.last, executed)
        _move(self.apartments, self.house, STRETCH.motion_of[executed], self.done, self.pose)
        self.t += 1
        self._look()

    @property
    def interfered(self) -> NDArray[np.bool_]:
        """[N] whether it is held or steered at this step."""
        during: NDArray[np.bool_] = (
            (self.t >= self.begin) & (self.t < self.begin + self.length) & (self.held | self.steered)
        ).any(axis=0)
        return during

    def _look(self) -> None:
        _look(
            self.apartments, STRETCH.representative, self.house, self.kind, self.other, self.done, self.pose,
            self.looked_at, self.noticed, self.goal, self.senses, self.advice, self.detour,
        )  # fmt: skip


def sample(distributions: NDArray[np.float32], random: np.random.Generator) -> NDArray[np.int64]:
    """One index a row. distributions [N, A]."""
    total = np.cumsum(distributions.astype(np.float64), axis=1)
    drawn: NDArray[np.int64] = (random.random((len(total), 1)) * total[:, -1:] > total).sum(axis=1)
    return drawn


@kernel
def _body(a: Apartments, house: int) -> Body:
    """The robot in another apartment, whose corner is the origin."""
    b = a.body
    return Body(
        a.occupied[house], a.clearance[house], b.resolution, 0.0, 0.0, 1.0, 0.0,
        b.radius, b.offset_x, b.offset_y, b.stop, b.translate, b.rotate,
    )  # fmt: skip


@kernel
def _place(
    a: Apartments, house: NDArray[np.int64], draws: NDArray[np.float64], pose: NDArray[np.float64]
) -> None:
    """The first of the draws [N, D, 3] that is not in collision; the last one where all are."""
    for n in range(pose.shape[0]):
        own = _body(a, house[n])
        for d in range(draws.shape[1]):
            pose[n] = draws[n, d]
            if not in_collision(own, pose[n, 0], pose[n, 1], pose[n, 2]):
                break


@kernel
def _move(
    a: Apartments,
    house: NDArray[np.int64],
    motions: NDArray[np.int64],
    done: NDArray[np.bool_],
    pose: NDArray[np.float64],
) -> None:
    for n in range(pose.shape[0]):
        if not done[n]:
            own = _body(a, house[n])
            pose[n, 0], pose[n, 1], pose[n, 2] = step(own, pose[n, 0], pose[n, 1], pose[n, 2], motions[n])


@leaf
def _mark(body: Body, x: float, y: float, theta: float, looked_at: NDArray[np.uint8]) -> None:
    """Marks the patches that the camera sees."""
    rays, patch = 25, PATCH * body.resolution
    for k in range(rays):
        angle = theta + FIELD_OF_VIEW * (k / (rays - 1) - 0.5)
        free = cast(body, x, y, angle, SIGHT)
        c, s, gone = math.cos(angle), math.sin(angle), 0.0
        while gone < free:
            looked_at[math.floor((y + gone * s) / patch), math.floor((x + gone * c) / patch)] = 1
            gone += 0.5 * patch


@leaf
def _notice(
    body: Body,
    x: float,
    y: float,
    theta: float,
    ranges: NDArray[np.float64],
    room_of: NDArray[np.int8],
    noticed: NDArray[np.uint8],
) -> None:
    """Marks the rooms that the scan reaches into."""
    patch = PATCH * body.resolution
    for k in range(ranges.shape[0]):
        angle = theta + 2.0 * math.pi * k / ranges.shape[0]
        c, s, gone = math.cos(angle), math.sin(angle), 0.0
        while gone < ranges[k]:
            room = room_of[math.floor((y + gone * s) / patch), math.floor((x + gone * c) / patch)]
            if room >= 0:
                noticed[room] = 1
            gone += 0.5 * patch


@kernel
def _next_room(
    a: Apartments,
    house: int,
    kind: int,
    goal: int,
    x: float,
    y: float,
    theta: float,
    looked_at: NDArray[np.uint8],
    noticed: NDArray[np.uint8],
) -> int:
    """The room to look at next, as an index into `ways`; the target where its room has been looked at.

    One of which something has been in sight, if there is any: the way that is shortest, turns included.
    """
    first, own = a.targets.shape[1], _body(a, house)
    row, col = math.floor(y / own.resolution), math.floor(x / own.resolution)
    count = np.zeros(a.floor.shape[1], np.int64)
    for i in range(looked_at.shape[0]):
        for j in range(looked_at.shape[1]):
            if looked_at[i, j] and a.room_of[house, i, j] >= 0:
                count[a.room_of[house, i, j]] += 1
    best, chosen = np.inf, -1
    for r in range(count.shape[0]):
        enough = count[r] >= LOOKED_AT * a.floor[house, r]
        if r == a.home[house, kind] and enough:
            return kind
        if enough:
            continue
        way = a.ways[house, first + r]
        cost = way[row, col] % OFF + TURN * abs(bearing_of_way(own, way, x, y, theta))
        if noticed[r] == 0:
            cost += UNNOTICED
        if first + r == goal:
            cost -= STAY
        if cost < best:
            best, chosen = cost, first + r
    return chosen


@kernel
def _look(
    a: Apartments,
    representative: NDArray[np.int64],
    house: NDArray[np.int64],
    kind: NDArray[np.int64],
    other: NDArray[np.int64],
    done: NDArray[np.bool_],
    pose: NDArray[np.float64],
    looked_at: NDArray[np.uint8],
    noticed: NDArray[np.uint8],
    goal: NDArray[np.int64],
    senses: NDArray[np.float32],
    advice: NDArray[np.float32],
    detour: NDArray[np.float32],
) -> None:
    ranges = np.empty(RAYS)
    for n in range(pose.shape[0]):
        if done[n]:
            continue
        i, x, y, theta = house[n], pose[n, 0], pose[n, 1], pose[n, 2]
        own = _body(a, i)
        scan(own, x, y, theta, ranges)
        senses[n, :RAYS] = ranges
        seen, distance, bearing = see(own, x, y, theta, a.targets[i, kind[n], 0], a.targets[i, kind[n], 1])
        senses[n, RAYS], senses[n, RAYS + 1], senses[n, RAYS + 2] = 1.0 if seen else 0.0, distance, bearing
        row, col = math.floor(y / own.resolution), math.floor(x / own.resolution)
        _mark(own, x, y, theta, looked_at[n])
        _notice(own, x, y, theta, ranges, a.room_of[i], noticed[n])
        if seen:
            goal[n] = kind[n]
        elif goal[n] != kind[n]:
            goal[n] = _next_room(a, i, kind[n], goal[n], x, y, theta, looked_at[n], noticed[n])
        near = seen and distance < END_WITHIN
        there = goal[n] != kind[n] and a.ways[i, goal[n], row, col] < THERE
        advise(own, representative, a.ways[i, goal[n]], x, y, theta, near, there, advice[n])
        there = a.ways[i, other[n], row, col] < THERE
        advise(own, representative, a.ways[i, other[n]], x, y, theta, False, there, detour[n])
