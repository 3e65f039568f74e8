"""Several robots at once, faults while they drive, and how long the service was away for them."""

from __future__ import annotations

import math
import random
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Any

from benchmarks.reliability.faults.check import check
from benchmarks.reliability.figures import spread
from benchmarks.reliability.plant import wait_for
from benchmarks.reliability.robots import Robot

BACK = 120.0  # [s] most that a fault may keep anybody waiting before the run is given up
PAUSES = (0.1, 0.8)  # [s] between two faults, drawn evenly, so that they meet requests at any point
ENDS = 300.0  # [s] most that the last episodes may take


@dataclass
class Away:
    """Seconds from a fault to the first answer that any robot got afterwards, and to the last robot's first.

    Only answers to requests that were sent after the fault count.
    """

    first: list[float]
    all: list[float]


class Crowd:
    """Half of the robots by the SDK, half by plain httpx."""

    def __init__(
        self, urls: Sequence[str], starts: Sequence[Sequence[float]], n: int, nap: float = 0.0, seed: int = 1
    ) -> None:
        self.over, self.away, self._drawn = threading.Event(), Away([], []), random.Random(seed)
        self.robots = [
            Robot(f"robot-{seed}-{i}", urls, starts, 100 * seed + i, self.over, i % 2 == 0, nap)
            for i in range(n)
        ]

    def __enter__(self) -> Crowd:
        for robot in self.robots:
            robot.start()
        self.back_since(time.monotonic())
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """The robots end the episodes they are in."""
        self.over.set()
        ends = time.monotonic() + (ENDS if error is None else 5.0)
        for robot in self.robots:
            robot.join(max(0.0, ends - time.monotonic()))
            if robot.is_alive():
                robot.episodes[-1].problem = "still in its episode when the run was given up"

    def fault(
        self, cause: Callable[[], object], mend: Callable[[], object] = lambda: None, gradual: bool = False
    ) -> float:
        """One fault: what causes it and what mends it. Returns when every robot had an answer again, with the
        moment at which it was caused (time.monotonic).

        gradual: robots are still answered while `cause` runs, and that is no answer after the fault.
        """
        time.sleep(self._drawn.uniform(*PAUSES))
        moment = time.monotonic()
        cause()
        caused = time.monotonic() if gradual else moment
        mend()
        times = self.back_since(moment, caused)
        self.away.first.append(min(times))
        self.away.all.append(max(times))
        return moment

    def back_since(self, moment: float, caused: float = 0.0) -> list[float]:
        """For each robot, the seconds from then to the first good answer to a request that it sent later, and
        not before `caused`. A robot that was not asking at that moment, or was answered before `caused`, has
        waited since its next request.
        """
        answered, asked = [0.0] * len(self.robots), [math.inf] * len(self.robots)
        looked = [max(0, len(robot.tries) - 50) for robot in self.robots]

        def look() -> bool:
            for i, robot in enumerate(self.robots):
                while not answered[i] and looked[i] < len(robot.tries):
                    tried = robot.tries[looked[i]]
                    looked[i] += 1
                    good = tried.status in (200, 201)
                    if tried.ended > moment:
                        asked[i] = min(asked[i], max(tried.began, moment))
                    if good and tried.began >= max(moment, caused):
                        answered[i] = tried.ended - asked[i]
                    elif good and tried.ended < caused:
                        asked[i] = math.inf
                if not robot.is_alive() and not answered[i]:
                    raise RuntimeError(f"{robot.name} gave up: {robot.episodes[-1].problem}")
            return all(answered)

        wait_for(look, BACK, "an answer to every robot")
        return answered

    def statuses(self) -> Counter[int]:
        """How many tries had which answer; 0 where none came."""
        return Counter(tried.status for robot in self.robots for tried in robot.tries)

    def result(self, url: str, reference: str) -> dict[str, Any]:
        """What came of it all, once the robots are done."""
        episodes = [episode for robot in self.robots for episode in robot.episodes]
        return {
            "robots": len(self.robots),
            **check(url, reference, episodes),
            "away_first_s": spread(self.away.first),
            "away_all_s": spread(self.away.all),
            "tries_by_status": _named(self.statuses()),
        }


def _named(statuses: Iterable[tuple[int, int]] | Counter[int]) -> dict[str, int]:
    return {str(status) if status else "none": count for status, count in sorted(dict(statuses).items())}
