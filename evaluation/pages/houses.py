"""The pages of other floor plans, and of what the whole body keeps out of."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from evaluation.evaluation import read
from evaluation.experiment import Experiment
from evaluation.pages.tables import Found, Results, beside_ours, better, row, title
from evaluation.results import markdown, share
from evaluation.runs import Record
from evaluation.statistics import clopper_pearson
from specshield.sim.cases import Case
from specshield.world.regions import signed_distance

KEPT_OUT = "Forbidden"  # the region that the cases' rules keep the robot out of


def houses(found: Found) -> Iterator[str]:
    """A row a house and method; how many starts were refused in each house."""
    formulas = dict.fromkeys(results["formula"] for results in found.values())
    yield (
        "Apartments drawn_N and large_N were drawn at random with the seed N, the large ones 15 x 12 m. The "
        "others are ProcTHOR houses, which are not in this repository (`evaluation/houses.py` says how to "
        f"get them). The rule is {', '.join(f'`{formula}`' for formula in formulas)}. A room holds where the "
        "robot's origin is in it. A start is refused where no future that keeps the rule was found; another "
        "is then drawn."
    )
    heads = (
        "house, model", "starts refused", "method", "rule kept", "main task done", "KL a run [nats]",
        "extra steps",
    )  # fmt: skip
    rows = [
        (title(results), _refused(results), *row(one))
        for results in found.values()
        for one in results["methods"]
    ]
    yield markdown(heads, rows)
    yield from better(found)
    for results in found.values():
        yield f"## {title(results)}"
        yield "\n".join(beside_ours(results))


def _refused(results: Results) -> str:
    """Of all starts that were drawn, each run's own included."""
    refused, of = results["refused_starts"], results["refused_starts"] + results["runs"]
    low, high = (round(bound, 4) for bound in clopper_pearson(refused, of))  # as statistics.py has it
    return share({"count": refused, "of": of, "low": low, "high": high})


def bodies(found: Found) -> Iterator[str]:
    """A row a rule, about the origin or about the body, and method: how often the body is in Forbidden."""
    yield (
        f"A region holds where the robot's origin is in it, as in the paper: `G not {KEPT_OUT}` keeps the "
        f"origin out, and the body may reach in. `G not touches({KEPT_OUT})` keeps all of the body out. The "
        "depth is measured from the recorded poses, by the distance of the footprint's centre from the "
        "region, at the steps of the rule; `python -m benchmarks.bodies` counts points of the body instead. "
        "Shown are the methods that were run with both rules."
    )
    heads = (
        "rule says", "starts refused", "method", "rule kept", "main task done", "KL a run [nats]",
        "extra steps", "body in Forbidden", "deepest, median [m]",
    )  # fmt: skip
    rows, shared = [], set.intersection(*({one["method"] for one in r["methods"]} for r in found.values()))
    for kept, results in found.items():
        case, records = Experiment.from_json(results["experiment"]).setting.case, read(kept)
        said = "the body" if f"touches({KEPT_OUT})" in results["formula"] else "the origin"
        for one in (each for each in results["methods"] if each["method"] in shared):
            depths = overlaps(case, [record for record in records if record.method == one["method"]])
            rows.append((said, _refused(results), *row(one), *_inside(depths)))
    yield markdown(heads, rows)


def overlaps(case: Case, records: Sequence[Record]) -> list[float]:
    """How deep each run's footprint was in KEPT_OUT at most, at the rule's steps [m]; 0 or less: never."""
    robot, region = case.task.robot, case.task.regions[KEPT_OUT]
    found = []
    for record in records:
        poses = np.array(record.poses[: case.task.horizon + 1])
        cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
        ahead, left = robot.offset
        centres = poses[:, :2] + np.stack([cos * ahead - sin * left, sin * ahead + cos * left], -1)
        found.append(float((robot.radius + signed_distance(region, centres)).max()))
    return found


def _inside(depths: Sequence[float]) -> tuple[str, str]:
    within = [depth for depth in depths if depth > 0.0]
    low, high = clopper_pearson(len(within), len(depths))
    count: dict[str, Any] = {"count": len(within), "of": len(depths), "low": low, "high": high}
    return share(count), f"{np.median(within):.3f}" if within else "-"
