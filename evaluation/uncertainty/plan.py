"""The campaigns of docs/results/uncertainty.md, the most important first: they may be stopped."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

PARTS = ("noise", "worlds", "forms", "thresholds", "mujoco", "switches", "robots", "yardstick")
CASES = ("case1", "case2", "drawn_0", "drawn_3")
NOISES = ("gaussian", "slip", "rough", "short")
WORLDS = {"case1": 60, "case2": 60, "drawn_3": 40, "drawn_0": 40}  # runs of each world and sense
UNTOLD = ("obstacle", "shift", "collider", "person")
ROBOTS = ("locobot", "trailing", "arcs")
LEAST = 4  # runs of a campaign that is cut short


@dataclass(frozen=True)
class Campaign:
    """part: of PARTS, a section of the page. name: of the file with its figures. words: its command, after
    `python -m` and without the number of runs, which `counted` is the option of. keeps: whether it takes an
    --out, so that it can be taken up in its middle.
    """

    part: str
    name: str
    words: str
    runs: int
    counted: str = "--runs"
    keeps: bool = False

    def command(self, share: float = 1.0) -> str:
        """The whole of it, as a page shows it. share: of the runs, for a first look."""
        runs = self.runs if share == 1.0 else max(LEAST, math.ceil(share * self.runs))
        return f"python -m {self.words} {self.counted} {runs}"


def plan(seed: int = 0) -> Iterator[Campaign]:
    """Every campaign, in the order in which they are run."""
    for case in CASES:
        for noise in ("none", *NOISES):
            methods = "ours,ours@default" if noise == "none" else "ours@default"
            asked = f"--case house --house {case}" if case.startswith("drawn") else f"--case {case}"
            words = f"evaluation evaluate {asked} --noise {noise} --model goal-seeker --methods {methods}"
            yield Campaign("noise", f"{case}-{noise}", f"{words} --seed {seed}", 200, keeps=True)
    for case, runs in WORLDS.items():
        for world in UNTOLD:
            words = f"evaluation worlds --case {case} --world {world} --seed {seed}"
            yield Campaign("worlds", f"{case}-{world}", words, runs, keeps=True)
    yield Campaign("forms", "forms-worlds", f"benchmarks.forms --worlds --seed {seed}", 8)
    yield Campaign("forms", "forms", f"benchmarks.forms --seed {seed}", 20)
    yield Campaign("thresholds", "thresholds", f"benchmarks.thresholds --seed {seed}", 1000, "--episodes")
    yield Campaign("mujoco", "mujoco", f"evaluation mujoco --case 1,2,drawn_3 --seed {seed}", 100)
    yield Campaign("switches", "switches", f"benchmarks.switches --seed {seed}", 200, "--switches")
    for robot in ROBOTS:
        for case in CASES[:2]:
            words = f"evaluation worlds --case {case} --robot {robot} --world told,shift,collider,obstacle"
            yield Campaign("robots", f"{robot}-{case}", f"{words} --seed {seed}", 30, keeps=True)
    for noise in NOISES:
        words = f"evaluation evaluate --case house --house drawn_3 --noise {noise} --model goal-seeker"
        words += f" --methods rule-first@default --seed {seed}"
        yield Campaign("yardstick", f"first-{noise}", words, 200, keeps=True)
