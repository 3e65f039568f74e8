"""What all pages share: one row for each method with intervals, comparisons with `ours`, and the commands."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from evaluation.calibration import kept_in
from evaluation.experiment import CERTIFYING, split
from evaluation.results import markdown, share

Results = dict[str, Any]
Found = Mapping[Path, Results]  # the folder that each experiment's results lie in

HEADS = ("case, model", "method", "rule kept", "main task done", "KL a run [nats]", "extra steps")
OUTCOMES = {"satisfied": "rule", "main_done": "main task"}
ENOUGH = 8  # runs or pairs, for a bootstrap's interval to be told; chosen by hand
UNLIKELY = 0.05  # a p below it counts as a difference
COSTS = {"kl": "KL a run", "extra_steps": "extra steps"}


def title(results: Results) -> str:
    return f"{results['case']}, {results['experiment']['model']}"


def summary_table(found: Iterable[Results], methods: Sequence[str] | None = None) -> str:
    """A row for each experiment and method, under HEADS. methods: those to show, None for all."""
    rows = [
        (title(results), *row(one))
        for results in found
        for one in results["methods"]
        if methods is None or one["method"] in methods
    ]
    return markdown(HEADS, rows)


def row(one: Mapping[str, Any]) -> tuple[str, ...]:
    """A method and its figures, each with its interval: shares as counts, means over runs."""
    if one["method"] == "unmodified":  # what the others are compared with
        return one["method"], share(one["satisfied"]), share(one["main_done"]), "0", "-"
    return one["method"], share(one["satisfied"]), share(one["main_done"]), kl(one), steps(one["extra_steps"])


def kl(one: Mapping[str, Any]) -> str:
    low, high = one["kl_interval"]
    return f"{one['kl']:.1f} ({low:.1f} to {high:.1f})"


def steps(later: Mapping[str, Any]) -> str:
    """The mean of the runs in which both did the main task, of which it says how many there are."""
    if later["mean"] is None:
        return "no run"
    if later["both"] < ENOUGH:
        return f"{later['mean']:+.1f}, n {later['both']}"
    return f"{later['mean']:+.1f} ({later['low']:+.1f} to {later['high']:+.1f}), n {later['both']}"


def beside_ours(results: Results) -> Iterator[str]:
    """A line for each other certifying method: what it does beside `ours`, run by run, whatever that says."""
    for method, found in results["beside_ours"].items():
        if split(method)[0] in CERTIFYING:
            costs = [f"{name} {compared(found[key])}" for key, name in COSTS.items()]
            tests = [f"{name} {test(found[key])}" for key, name in OUTCOMES.items()]
            yield f"- {method}, beside {found['other']}: {'; '.join([*costs, *tests])}."


def better(found: Found) -> Iterator[str]:
    """A section: what other methods do better than `ours`, of those that keep the rule as well."""
    yield "## What does better than ours"
    yield (
        "Methods that keep the rule as often, as far as McNemar's test tells (p >= 0.05), or more often; of "
        "those, where the 95 % interval of the difference in steps or KL lies below 0 (8 pairs or more), or "
        "where more runs keep the rule or do the main task (p < 0.05). Of so many comparisons, a few are so "
        "by chance."
    )
    lines = []
    for results in found.values():
        world = results["experiment"]["noise"]
        where = title(results) if world == "none" else f"{title(results)}, {world}"
        for method, said in _better(results):
            other = results["beside_ours"][method]["other"]
            figures = "; ".join(f"{name} {figure}" for name, figure in said.items())
            lines.append(f"- **{method}**, beside {other} ({where}): {figures}.")
    yield "\n".join(lines) or "- None was found."


def better_in_short(found: Found) -> Iterator[str]:
    """The same section without the figures: what each method does better, and where."""
    where: dict[tuple[str, str], list[str]] = {}
    for results in found.values():
        for method, said in _better(results):
            for name in said:
                where.setdefault((method, name), []).append(title(results))
    yield "## What does better than ours"
    yield (
        "Of all methods, in the cases and models of the first table, those that keep the rule as often and "
        "whose 95 % interval of the difference in KL or steps lies below 0, or that do more main tasks "
        "(p < 0.05). Of so many comparisons, a few are so by chance. The figures are on the page of the "
        "cases; noise, other models and other tasks are on theirs. **switching**: the model until a draw is "
        "not feasible, then the plan to the next visit. **visits-first**: the plan until every F is met, "
        "then ours. **adaptive@0/25**: ours with up to 25 steps of slack, by how much probability the model "
        "lately gave to infeasible actions."
    )
    found_better = [f"**{method}**: {name} ({'; '.join(there)})" for (method, name), there in where.items()]
    yield f"{'. '.join(found_better) or 'None was found'}."


def _better(results: Results) -> Iterator[tuple[str, dict[str, str]]]:
    """Each method that does better than `ours` in something, and in what, with the figure."""
    for method, found in results["beside_ours"].items():
        kept = found["satisfied"]
        if split(method)[0] not in CERTIFYING or (kept["p"] < UNLIKELY and kept["only"] < kept["only_other"]):
            continue
        said = {
            name: difference(found[key])
            for key, name in COSTS.items()
            if found[key]["pairs"] >= ENOUGH and found[key]["difference_high"] < 0.0
        }
        said |= {
            name: test(found[key])
            for key, name in OUTCOMES.items()
            if found[key]["p"] < UNLIKELY and found[key]["only"] > found[key]["only_other"]
        }
        if said:
            yield method, said


def test(found: Mapping[str, Any]) -> str:
    """McNemar's, in words."""
    return (
        f"{found['only']} runs it alone, {found['only_other']} the other alone, of {found['pairs']}, "
        f"p = {found['p']:.2g}"
    )


def compared(cost: Mapping[str, Any]) -> str:
    """Both means, the difference with its interval, and the ratio where there is one."""
    if not cost["pairs"]:
        return "in no pair of runs"
    said = f"{cost['mine']:.1f} and {cost['other']:.1f}, difference {difference(cost)}"
    if cost["share"] is None:
        return f"{said}, no ratio to a cost of {cost['other']:.1f}"
    if cost["pairs"] < ENOUGH:
        return f"{said}, ratio {cost['share']:.2f}"
    within = "not bounded" if cost["low"] is None else f"{cost['low']:.2f} to {cost['high']:.2f}"
    return f"{said}, ratio {cost['share']:.2f} ({within})"


def difference(cost: Mapping[str, Any]) -> str:
    low, high = cost["difference_low"], cost["difference_high"]
    if cost["pairs"] < ENOUGH:
        return f"{cost['difference']:+.1f}, n {cost['pairs']}"
    return f"{cost['difference']:+.1f} ({low:+.1f} to {high:+.1f}), n {cost['pairs']}"


def about(results: Results) -> str:
    """The rule, the model, and how many starts were refused."""
    asked = results["experiment"]
    return (
        f'`{results["formula"]}`, model {asked["model"]} ("{results["instruction"]}"), '
        f"{results['runs']} runs, seed {asked['seed']}; {results['refused_starts']} more starts were drawn "
        "and refused, because `ours`, or the network alone where a case has one, found no future from there "
        "that keeps the rule."
    )


def commands(folder: Path, found: Found) -> str:
    """A block with the command of each experiment. folder: what was written up, taken for a part of out/."""
    top, lines = Path("out") / folder.resolve().name, []
    for kept, results in found.items():
        asked, case = results["experiment"], results["case"]
        if asked["house"]:
            of = "" if asked["house"] == case else " --houses FOLDER"
            case = f"house --house {case}{of}"
        out = top / kept.parent.parent.relative_to(folder)
        for runs in dict.fromkeys(one["runs"] for one in results["methods"]):
            shown = (one["method"] for one in results["methods"] if one["runs"] == runs)
            methods = ",".join(_as_asked(kept, method) for method in shown)
            lines.append(
                f"specshield evaluate --case {case} --runs {runs} --seed {asked['seed']} "
                f"--model {asked['model']} --noise {asked['noise']} --methods {methods} --out {out}"
            )
    return "```sh\n" + "\n".join(lines) + "\n```"


def _as_asked(kept: Path, method: str) -> str:
    """The method as it was asked for: NAME@conformal/K where a calibration in `kept` made its margin."""
    for name, made in kept_in(kept).items():
        margin = f"@{made['rounded']:g}{made['asked']}"
        if method.endswith(margin):
            return f"{method.removesuffix(margin)}@{name}"
    return method
