"""A search for a way that keeps a rule of discs, which knows nothing of policies, tables or formulas.

Breadth first over places, headings and what is met, in steps of time: every motion is simulated by f, and
discs are measured here. Poses that are nearly the same count once, so a way that it finds is one that the
robot can go, and one that it does not find may exist all the same.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from specshield.robot.dynamics import Body, step

# Not cached: on the disk it would not notice that the package's functions changed.
compiled: Any = numba.njit
Floats = NDArray[np.float64]
Disc = tuple[float, float, float]  # x, y, radius [m]
CELL, HEADINGS = 0.1, 60  # [m] and per turn: what counts as one place
MOST = 2_000_000  # states of one search
NEVER = 1_000_000  # [steps]


@dataclass(frozen=True)
class Part:
    """A conjunct. reach: F[a,b] G[0,stay] disc. stay: G[a,b] disc. out: G[a,b] not disc. until: not left
    U[a,b] disc.
    """

    kind: str
    disc: Disc
    a: int
    b: int
    dwell: int = 0
    left: Disc | None = None

    def text(self, names: Sequence[str]) -> str:
        """names: of the disc, and of the left one."""
        match self.kind:
            case "reach":
                return f"F[{self.a},{self.b}] " + (f"G[0,{self.dwell}] " if self.dwell else "") + names[0]
            case "until":
                return f"not {names[1]} U[{self.a},{self.b}] {names[0]}"
        return f"G[{self.a},{self.b}] " + ("not " if self.kind == "out" else "") + names[0]

    @property
    def is_goal(self) -> bool:
        return self.kind in ("reach", "until")

    def later(self, steps: int) -> Part:
        """The same with a window that ends, or for a place to stay in begins, so much later."""
        if self.kind == "stay":
            return replace(self, a=min(self.a + steps, self.b))
        return replace(self, b=self.b + steps)


def rule(parts: Sequence[Part]) -> tuple[str, dict[str, Any]]:
    """The formula and its regions."""
    regions, texts = dict[str, Any](), []
    for part in parts:
        names = []
        for disc in filter(None, (part.disc, part.left)):
            names.append("ABCDEFGH"[len(regions)])
            regions[names[-1]] = {"type": "circle", "center": list(disc[:2]), "radius": disc[2]}
        texts.append(part.text(names))
    return " and ".join(texts), regions


def earliest(
    body: Body, wait: int, history: Floats, parts: Sequence[Part], until: int, cell: float = CELL
) -> int:
    """The first step by which the search has met all goals and need only stand from then on; -1 where it
    finds none up to step `until`. history [t + 1, 3]; cell [m]: what counts as one place.
    """
    goals = [part for part in parts if part.is_goal]
    rows = np.array([[*p.disc, p.a, p.b, p.dwell] for p in goals]).reshape(-1, 6)
    outs = [[*p.disc, p.a, p.b, p.kind == "stay", -1] for p in parts if not p.is_goal]
    outs += [[*p.left, 0, p.b, 0, k] for k, p in enumerate(goals) if p.left is not None]
    guards, now = np.array(outs, np.float64).reshape(-1, 7), len(history) - 1
    met, begun = 0, np.zeros(len(goals), np.int64)  # since when the robot has been in each disc
    for t, (x, y, _) in enumerate(history):
        for k, goal in enumerate(goals):
            if t < goal.a or not _inside(x, y, rows[k]):
                begun[k] = t + 1
            elif begun[k] <= goal.b and t - begun[k] >= goal.dwell:
                met |= 1 << k
        if not _allowed(x, y, t, met, guards):
            return -1
    height, width = body.occupied.shape
    shape = (
        1 << len(goals),
        int(height * body.resolution / cell) + 2,
        int(width * body.resolution / cell) + 2,
        HEADINGS,
    )
    seen = np.zeros(shape, np.uint8)
    return int(_search(body, wait, history[-1], now, met, begun, rows, guards, until, seen, cell))


@compiled
def _inside(x: float, y: float, row: Floats) -> bool:
    return math.hypot(x - row[0], y - row[1]) < row[2]


@compiled
def _allowed(x: float, y: float, t: int, met: int, guards: Floats) -> bool:
    for g in range(guards.shape[0]):
        row = guards[g]
        goal = int(row[6])
        if row[3] <= t <= row[4] and not (goal >= 0 and met >> goal & 1):
            distance = math.hypot(x - row[0], y - row[1])
            if (row[5] > 0.0 and not distance < row[2]) or (row[5] == 0.0 and not distance > row[2]):
                return False
    return True


@compiled
def _stands(x: float, y: float, first: int, last: int, met: int, guards: Floats) -> bool:
    stands = True
    for s in range(first, last + 1):
        stands = stands and _allowed(x, y, s, met, guards)
    return stands


@compiled
def _search(body, wait, pose, now, met0, begun, rows, guards, until, seen, cell):  # type: ignore[no-untyped-def]
    """A state that was reached may wait where it is; it is gone on from once, and again when a guard ends."""
    every, motions, last = seen.shape[0] - 1, body.translate.shape[0], now
    for g in range(guards.shape[0]):
        last = max(last, int(guards[g, 4]))
    xs, ys, hs = np.empty(MOST), np.empty(MOST), np.empty(MOST)
    met, ready = np.empty(MOST, np.int64), np.empty(MOST, np.int64)
    alive, onward = np.ones(MOST, np.bool_), np.ones(MOST, np.bool_)
    xs[0], ys[0], hs[0], met[0], ready[0] = pose[0], pose[1], pose[2], met0, now
    count = 1
    for t in range(now, until + 1):
        ended = False
        for g in range(guards.shape[0]):
            ended = ended or t == int(guards[g, 4]) + 1
        stop = count if t > now else 0
        for i in range(stop):
            onward[i] = onward[i] or ended
            if not (alive[i] and onward[i]) or ready[i] > t - 1:
                continue
            onward[i] = False
            for m in range(motions):
                if m == wait:
                    continue
                x, y, h = step(body, xs[i], ys[i], hs[i], m)
                if not _allowed(x, y, t, met[i], guards):
                    continue
                j, k, q = _place(body, x, y, h, cell)
                if j < 0 or k < 0 or j >= seen.shape[1] or k >= seen.shape[2] or seen[met[i], j, k, q]:
                    continue
                seen[met[i], j, k, q] = 1
                if count == MOST:
                    return -1
                xs[count], ys[count], hs[count], met[count], ready[count] = x, y, h, met[i], t
                count += 1
        i = 0
        while i < count:
            if alive[i] and ready[i] <= t and not _allowed(xs[i], ys[i], t, met[i], guards):
                alive[i] = False
                j, k, q = _place(body, xs[i], ys[i], hs[i], cell)
                seen[met[i], j, k, q] = 0
            elif alive[i] and ready[i] <= t:
                for g in range(rows.shape[0]):
                    bit, first = 1 << g, t
                    if t == now:
                        first = begun[g]
                    if met[i] & bit or not (ready[i] == t or t == rows[g, 3]):
                        continue
                    if not _inside(xs[i], ys[i], rows[g]):
                        continue
                    if not rows[g, 3] <= first <= rows[g, 4] or count == MOST:
                        continue
                    over = max(t, first + int(rows[g, 5]))
                    if _stands(xs[i], ys[i], t, over, met[i] | bit, guards):
                        xs[count], ys[count], hs[count] = xs[i], ys[i], hs[i]
                        met[count], ready[count] = met[i] | bit, over
                        count += 1
                if met[i] == every and _stands(xs[i], ys[i], t, last, every, guards):
                    return t
            i += 1
    return -1


@compiled
def _place(body, x, y, h, cell):  # type: ignore[no-untyped-def]
    j, k = int((y - body.origin_y) / cell), int((x - body.origin_x) / cell)
    return j, k, round(h * HEADINGS / (2 * math.pi)) % HEADINGS
