"""Look-ahead beside the simplest rivals, slacks of four kinds, on models of several families, in both cases.

The rule by which look-ahead stays was set before the runs: KL at most KL_SHARE times that of the best
slack, and steps no more, in sum over all models and cases; and at most ADDED above projection in the share
SINGLE of the runs in which projection hardly intervenes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from evaluation.evaluation import evaluate
from evaluation.experiment import Experiment
from evaluation.houses import DRAWN
from evaluation.pages.tables import difference
from evaluation.results import markdown, share
from evaluation.runs import Record
from evaluation.statistics import NOTHING, clopper_pearson, compared, mean_of
from evaluation.writeup import write_page

FAMILIES = ("bot", "goal-seeker", "jumper", "learned", "rover", "unsteered")
SLACKS = ("ours", "ours@0/25", "proportional@0/25", "adaptive@0/25")  # ours: a slack of 0, projection alone
METHODS = ("unmodified", *SLACKS, "lookahead")
KL_SHARE, SINGLE = 0.8, 0.95
HARDLY, ADDED = 1.0, 1.0  # [nats]
ABOUT = """# Look-ahead beside slacks

Written by `{command}`: models: {models}, cases: {cases}, {runs} runs of each by every method, which share
starts, model seeds and draws. KL: summed along a run, in nats, mean over runs. Steps: until the model has
done its main task, {limit} where it does not; mean over runs. In brackets are 95 % intervals of a
bootstrap over runs, or over whole pairs of runs. NAME@0/K: K steps of slack, or K per cent of the window,
or at most K steps. In the sums the models and cases weigh alike. The robot moves as the shield was told,
and `uncertainty` is `"none"`. The models are described in [results/cases.md](results/cases.md) and
[results/models.md](results/models.md)."""


def measure(
    runs: int, seed: int, models: Sequence[str], cases: Sequence[str], out: Path, page: Path, processes: int
) -> None:
    """Runs what `out` does not hold yet, prints what came of it and writes the page.

    cases: names of cases, or of houses that are drawn.
    """
    asked: dict[tuple[str, str], Experiment] = {}
    for model in models:
        for case in cases:
            house = case if DRAWN.fullmatch(case) else None
            asked[model, case] = Experiment("house" if house else case, house, model, seed=seed)
            _ = asked[model, case].setting  # refused now where there is none, and not after hours of runs
    found: dict[tuple[str, str], list[Record]] = {}
    for (model, case), experiment in asked.items():
        folder = out / model / case / experiment.noise
        found[model, case] = evaluate(experiment, runs, METHODS, folder, processes)
    command = f"python -m evaluation rivals --runs {runs} --seed {seed} --case {','.join(cases)}"
    if tuple(models) != FAMILIES:
        command += f" --model {','.join(models)}"
    limit = experiment.main.limit
    about = ABOUT.format(command=command, models=len(models), cases=len(cases), runs=runs, limit=limit)
    parts = [about, *tables(found, limit), *verdict(found, limit)]
    print("\n\n".join(parts))
    write_page(page, parts)


Found = Mapping[tuple[str, str], Sequence[Record]]


def tables(found: Found, limit: int) -> list[str]:
    """One of KL and one of steps, with a row a model and case, and their sums."""
    made = []
    for name in ("KL", "steps"):
        rows = [
            [f"{model}, {case}", *(_with_interval(records, method, name, limit) for method in METHODS)]
            for (model, case), records in found.items()
        ]
        sums = _sums(found, name, limit)
        rows.append(["**sum**", *(f"**{sums[method]:.1f}**" for method in METHODS)])
        made.append(f"## {name}\n\n{markdown(('model, case', *METHODS), rows)}")
    done = [
        [f"{model}, {case}", *(str(sum(r.main_done for r in records if r.method == m)) for m in METHODS)]
        for (model, case), records in found.items()
    ]
    of = len(next(iter(found.values()))) // len(METHODS)
    made.append(f"## Main task done, of {of}\n\n{markdown(('model, case', *METHODS), done)}")
    apart = [
        [f"{model}, {case}", *(difference(compared(_pairs(records, "lookahead", "ours", name, limit)))
                               for name in ("KL", "steps"))]
        for (model, case), records in found.items()
    ]  # fmt: skip
    heads = ("model, case", "KL", "steps")
    return [*made, f"## Look-ahead less projection, run by run\n\n{markdown(heads, apart)}"]


def verdict(found: Found, limit: int) -> list[str]:
    """The rule's three parts, each with its figure, and how much each method costs beside projection."""
    kl, steps = _sums(found, "KL", limit), _sums(found, "steps", limit)
    best_kl, best_steps = min(SLACKS, key=kl.__getitem__), min(SLACKS, key=steps.__getitem__)
    alone = [pair for each in found.values() for pair in _pairs(each, "lookahead") if pair[1] < HARDLY]
    within = sum(mine <= other + ADDED for mine, other in alone)
    said = _share(within, len(alone))
    why = "; it could not be otherwise, since look-ahead begins once the rule has cost 1 nat" if alone else ""
    beside = compared([pair for each in found.values() for pair in _pairs(each, "lookahead", best_kl)])
    later = compared(
        [pair for each in found.values() for pair in _pairs(each, "lookahead", best_steps, "steps", limit)]
    )
    kept = _met(within >= SINGLE * len(alone)) if alone else "nothing to judge"
    parts = [
        f"- KL in sum: look-ahead's is {_ratio(kl, best_kl, beside)} of the "
        f"best slack's, `{best_kl}`; at most {KL_SHARE:g} is asked: "
        f"{_met(kl['lookahead'] <= KL_SHARE * kl[best_kl] + NOTHING)}.",
        f"- Steps in sum: look-ahead's are {_ratio(steps, best_steps, later)} of those of the best slack, "
        f"`{best_steps}`; at most 1 is asked: {_met(steps['lookahead'] <= steps[best_steps])}.",
        f"- Single runs in which projection's KL is below {HARDLY:g}: look-ahead's is at most {ADDED:g} nat "
        f"more in {said}; {100 * SINGLE:g} % is asked: {kept}{why}.",
    ]
    return ["## What was asked of look-ahead before these runs", "\n".join(parts)]


def _ratio(sums: Mapping[str, float], best: str, beside: Mapping[str, Any]) -> str:
    """Look-ahead's sum as a share of another's, with its interval as far as there is one."""
    if sums[best] <= NOTHING:
        return f"{sums['lookahead']:.2f} beside the {sums[best]:.2f}"
    within = "not bounded" if beside["low"] is None else f"{beside['low']:.2f} to {beside['high']:.2f}"
    return f"{sums['lookahead'] / sums[best]:.2f} ({within})"


def _met(so: bool) -> str:
    return "**met**" if so else "**not met**"


def _share(count: int, of: int) -> str:
    if of == 0:
        return "no run (there are none)"
    low, high = clopper_pearson(count, of)
    return share({"count": count, "of": of, "low": low, "high": high})


def _means(records: Sequence[Record], name: str, limit: int) -> dict[str, float]:
    return {
        method: float(np.mean([_cost(r, name, limit) for r in records if r.method == method]))
        for method in METHODS
    }


def _with_interval(records: Sequence[Record], method: str, name: str, limit: int) -> str:
    of = mean_of([_cost(r, name, limit) for r in records if r.method == method])
    return f"{of['mean']:.1f} ({of['low']:.1f} to {of['high']:.1f})"


def _sums(found: Found, name: str, limit: int) -> dict[str, float]:
    means = [_means(records, name, limit) for records in found.values()]
    return {method: sum(each[method] for each in means) for method in METHODS}


def _cost(record: Record, name: str, limit: int) -> float:
    if name == "KL":
        return record.kl
    return record.ended_at if record.main_done and record.ended_at is not None else limit


def _pairs(
    records: Sequence[Record], method: str, beside: str = "ours", name: str = "KL", limit: int = 0
) -> list[tuple[float, float]]:
    """What the same runs cost by two methods: KL or steps, as `_cost` has them."""
    other = {each.run: _cost(each, name, limit) for each in records if each.method == beside}
    return [(_cost(each, name, limit), other[each.run]) for each in records if each.method == method]
