"""Runs that kept their rule, by how many steps their starts leave to spare.

    python -m benchmarks.spare out/results/goal-seeker/drawn_3/gaussian [...]

Each folder is one that `evaluate --out` has written. A start's steps to spare are the most slack with which
the shield certifies a future from there, for the deadline that is next, up to MOST and half of its window.
"""

from __future__ import annotations

import sys
from collections import Counter
from itertools import pairwise
from pathlib import Path

from evaluation.evaluation import read, read_about
from specshield.episode import decide, make_shield
from specshield.shield.decision import Config

MOST = 60  # [steps]
BOUNDS = (0, 3, 6, 9, 12, MOST + 1)  # [steps] of the columns


def main() -> None:
    heads = [f"{low} to {high - 1}" for low, high in pairwise(BOUNDS)]
    print(f"| world | method | {' | '.join(heads)} |\n|---|---|{'--:|' * len(heads)}")
    for folder in map(Path, sys.argv[1:]):
        experiment, _ = read_about(folder)
        shield = make_shield(experiment.setting.policies, Config(slack=MOST))
        spare, kept, of = dict[int, int](), Counter[tuple[str, int]](), Counter[tuple[str, int]]()
        for record in read(folder):
            if record.run not in spare:
                spare[record.run] = decide(shield, [record.start], None, main_task_done=True).slack
            column = sum(spare[record.run] >= low for low in BOUNDS) - 1
            of[record.method, column] += 1
            kept[record.method, column] += record.satisfied
        for method in dict.fromkeys(method for method, _ in of):
            cells = (f"{kept[method, i]} of {of[method, i]}" for i in range(len(heads)))
            print(f"| {experiment.setting.case.name}, {experiment.noise} | {method} | {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
