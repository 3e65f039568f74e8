"""A page of results with its figures, from what `specshield evaluate --out` has kept.

Every figure in the page is read from a results.json; the words around them are here.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from evaluation import figures
from evaluation.disturbance import DISTURBANCES
from evaluation.evaluation import read
from evaluation.experiment import CERTIFYING, Experiment, split
from evaluation.results import markdown, share, table, write
from specshield.errors import NotFound

PAPER = {  # Table II: rule satisfied and main task done, in per cent of 200 runs
    "case1": {"unmodified": (0.0, 93.5), "paper": (100.0, 92.5)},
    "case2": {"unmodified": (0.0, 99.0), "paper": (100.0, 82.5)},
}
METHODS = {
    "unmodified": "the model's own draws; after its `end` the robot stands still.",
    "hcd": """next-step masking, SafeDec's hard constrained decoding: a logit becomes minus infinity where the
  states so far and the next one leave some conjunct no chance, whatever follows. After the model's `end` the
  robot stands still.""",
    "hcd+": """hcd, and from the model's `end` on the certified continuation until the rule is decided; where
  none was found, the policy's best try.""",
    "rcd": """SafeDec's robust constrained decoding: logit + beta exp(alpha rho(next state)), with rho of the
  predicates that are asked for at the next step; alpha = {alpha:g} per metre, beta = {beta:g}, the best of 24
  pairs by runs that kept the rule, on other seeds. After the model's `end` the robot stands still.""",
    "rcd+": "rcd, with the same completion after the model's `end` as hcd+.",
    "simplex": "the model's own draw where it is feasible, else the certified continuation.",
    "switching": """the model's own draws until one is not feasible, which is when the slack has run out; then
  the plan drives until it has met the next obligation, and hands back. A draw that would break a G at once is
  only replaced. While the plan drives, the model may still say `end`.""",
    "rule-first": """the certified continuation until the rule is decided, and then the model alone. Its KL is
  that of the plan's actions from what the model wanted meanwhile.""",
    "paper": """the paper's decision rule with our DQN as pi_phi, rolled out literally after every action;
  hard projection. It is not the paper's policy: the shipped DQNs learned from the reward `progress`, not
  from the paper's funnels (`models/*/card.json`).""",
    "ours": """reachability and the DQN together; the certified continuation of each decision is handed to the
  next; hard projection.""",
    "lookahead": """ours, with the feasible actions weighted by what the rule will still cost the model from
  there, as far as a surrogate fitted to its logits can tell.""",
}
OUTCOMES = {"satisfied": "rule", "main_done": "main task"}
CAREFUL = "- **NAME@M/K**: that method with a margin of M metres, each deadline aimed at K steps early."
NOISES = {
    "none": "the world is as the shield was told",
    "gaussian": "every motion ends off by sigma 0.01 m along x and along y, and by sigma 0.5 degrees",
    "slip": "5 % of the motions do nothing",
    "rough": "every motion ends off by twice as much as under gaussian",
    "obstacle": "a box 0.3 m wide that is on no map stands on the way that was certified at the start",
    "shift": "walls and furniture stand 0.05 m from where the map has them, along x or y",
    "collider": "the footprint lies behind the robot's origin; the shield was told that it is centred",
}

MODELS = {
    "decoyed": """a goal-seeker that goes to another place first, and stays near it for some tens of steps
  before it turns to its target.""",
    "drifter": """it goes nowhere for a long time, while its preferences for actions drift, and then seeks
  its target.""",
    "goal-seeker": """it is told the way along free space and strays from it. Look-ahead's surrogate of a
  model is nearly of this kind, so look-ahead is at its best here.""",
    "jumper": "a goal-seeker that sets out for another place at random steps, and in the end for its target.",
    "learned": """a transformer that imitates shortest paths, from egocentric senses. It was trained with
  interference: in half of its training episodes it was held or steered elsewhere for tens of steps, as a
  shield does. It probably bears being steered better than a model that never was.""",
}
NOT_THE_SAME = """\
The paper's figures are of other models, maps and simulators; only the shapes of the rules are the same. The
maps here are drawn, and their regions placed, so that a robot that only seeks its target breaks the rule. A
region holds when the robot's origin is in it, as in the paper: a rule to stay out of a region does not keep
the whole body out of it."""
WHY_NEXT_STEP = """\
Next-step methods notice a window at its last step only: when the place to visit is further away than one
step, no action is left that reaches it in time. HCD keeps a G. What RCD adds to the logits leads straight
towards a place, also where a wall is between."""
WHY_SLACK = """\
Projection lets a model put a visit off to the last step from which it can still be certified, and noise can
then take that step away: slack gives time back. A margin keeps a distance from what is forbidden, and asks
for visits that reach further into a region than its edge. Without them, `ours` need not do better than
`paper`. The slack of 8 steps was chosen by hand. The calibrated margin covers the surprise of one step; it
promises nothing about the rule as a whole."""

Results = dict[str, Any]


def write_up(folder: Path, page: Path) -> None:
    """Writes the page, and the figures of each experiment in the world as told beside it.

    folder: as `specshield evaluate --out` was given, or one that holds such folders, one a model. Raises
    NotFound where it holds no results.
    """
    written = [*folder.glob("*/*/runs.jsonl"), *folder.glob("*/*/*/runs.jsonl")]
    found = {runs.parent: write(runs.parent) for runs in sorted(written)}
    if not found:
        raise NotFound(
            "there are no results", path="results", got=str(folder),
            expected="a folder that `specshield evaluate --out` has written",
        )  # fmt: skip
    beside = page.with_suffix("")
    drawn = {
        kept: figures.draw(_case(results), read(kept), beside / kept.parent.relative_to(folder))
        for kept, results in found.items()
        if results["experiment"]["noise"] == "none"
    }
    page.parent.mkdir(parents=True, exist_ok=True)
    page.write_text("\n\n".join(_sections(folder, found, drawn, page)) + "\n")


def _case(results: Results) -> Any:
    return Experiment.from_json(results["experiment"]).setting.case


def _sections(
    folder: Path, found: dict[Path, Results], drawn: dict[Path, list[Path]], page: Path
) -> Iterator[str]:
    from evaluation.decoding import ALPHA, BETA

    told = {kept: r for kept, r in found.items() if r["experiment"]["noise"] == "none"}
    yield "# Results"
    yield (
        "Written by `specshield report`; every figure is from a campaign's `results.json`. Shares carry "
        "their 95 % Clopper-Pearson intervals. All methods share starts, model seeds, draws and "
        "disturbances, run by run. The main task is done when the model says `end` within 1 m of its target "
        "before 600 steps. The p50 and p99 of a decision are over all decisions of all runs. Means and "
        "ratios have 95 % intervals of a bootstrap over runs, or over whole pairs of runs; shares of the "
        "same runs are compared by McNemar's exact test."
    )
    there = {split(one["method"])[0] for r in found.values() for one in r["methods"]}
    legend = [f"- **{name}**: {text}" for name, text in METHODS.items() if name in there]
    yield "\n".join([*legend, CAREFUL]).format(alpha=ALPHA, beta=BETA)
    yield "## Beside the paper's Table II"
    yield _beside(r for r in told.values() if r["experiment"]["house"] is None)
    yield NOT_THE_SAME
    if there & {"hcd", "rcd"}:
        yield WHY_NEXT_STEP
    yield "The models know no rule:"
    used = dict.fromkeys(_model(results) for results in found.values())
    yield "\n".join(f"- **{name}**: {MODELS[name]}" for name in used)
    yield (
        "In the pictures of ways, blue runs kept the rule and orange ones did not; what came after the "
        "rule's horizon is grey."
    )
    for kept, results in told.items():
        yield f"## {_title(results)}: method by method"
        yield _about(results)
        yield table(results)
        yield _short(results)
        for path in drawn[kept]:
            yield f"![{path.stem} of {_title(results)}]({path.relative_to(page.parent)})"
    disturbed = [r for r in found.values() if r["experiment"]["noise"] != "none"]
    if disturbed:
        yield "## Noise and mismatch"
        yield "\n".join(f"- **{name}**: {NOISES[name]}." for name in DISTURBANCES[1:])
        for title in dict.fromkeys(map(_title, disturbed)):
            yield f"### {title}"
            yield _noise_table([r for r in found.values() if _title(r) == title])
        yield WHY_SLACK
        yield from _calibrations(found)
    yield "## How it was run"
    yield "```sh\n" + "\n".join(_commands(folder, found, page)) + "\n```"


def _model(results: Results) -> str:
    return str(results["experiment"]["model"])


def _title(results: Results) -> str:
    return f"{results['case']}, {_model(results)}"


def _about(results: Results) -> str:
    about = results["experiment"]
    return (
        f'`{results["formula"]}`, model {about["model"]} ("{results["instruction"]}"), '
        f"{results['runs']} runs, seed {about['seed']}; {results['refused_starts']} more starts were drawn "
        "and refused, because no future that keeps the rule was found from there."
    )


def _beside(cases: Iterable[Results]) -> str:
    rows = []
    for results in cases:
        for one in results["methods"]:
            theirs = PAPER.get(results["case"], {}).get(one["method"])
            said = ("-", "-") if theirs is None else (f"{theirs[0]:g} %", f"{theirs[1]:g} %")
            of = one["runs"]
            kept, done = one["satisfied"]["count"], one["main_done"]["count"]
            rows.append(
                (_title(results), one["method"], *said, f"{100 * kept / of:g} %", f"{100 * done / of:g} %")
            )
    heads = (
        "case, model",
        "method",
        "the paper: rule",
        "the paper: main task",
        "here: rule",
        "here: main task",
    )
    return markdown(heads, rows)


def _short(results: Results) -> str:
    """Which conjuncts each method did not keep, and why main tasks were not done."""
    lines = []
    for one in results["methods"]:
        parts = []
        if one["broken"]:
            broken = (f"`{part}` {n}" for part, n in sorted(one["broken"].items()))
            parts.append(f"broken in runs: {', '.join(broken)}")
        missed = one["runs"] - one["main_done"]["count"]
        if missed:
            parts.append(
                f"main task not done in {missed}: never ended {one['never_ended']}, ended elsewhere "
                f"{one['ended_elsewhere']}"
            )
        common = one["common"]
        if common["runs"] and split(one["method"])[0] in CERTIFYING:
            points = 100 * (common["unmodified"] - common["main_done"]) / common["runs"]
            over = "" if common["runs"] == one["runs"] else f" over the {common['runs']} runs that both have"
            parts.append(f"main task {points:+.1f} points below unmodified{over}")
        if parts:
            lines.append(f"- {one['method']}: {'; '.join(parts)}.")
    lines += _beside_ours(results["beside_ours"])
    left = results["left"]
    if left["of"]:
        lines.append(
            f"- A rule may keep the model from its task until the horizon. In the {left['steps']} steps "
            f"that are then left, unmodified does its task in {left['done']} of {left['of']} runs."
        )
    return "\n".join(lines)


def _beside_ours(beside: Mapping[str, Mapping[str, Mapping[str, Any]]]) -> Iterator[str]:
    """What each certifying method costs beside the projection, run by run, whatever it says."""
    names = {"kl": "KL a run", "extra_steps": "mean extra steps"}
    for method, found in beside.items():
        if split(method)[0] not in CERTIFYING:
            continue
        parts = [f"{names[name]} {_compared(found[name])}" for name in names]
        tests = [f"{name} p = {found[key]['p']:.2g}" for key, name in OUTCOMES.items()]
        yield f"- {method}, beside ours: {', '.join(parts)}; McNemar: {', '.join(tests)}."


def _compared(cost: Mapping[str, Any]) -> str:
    """Both means, the difference with its interval, and the share where there is one."""
    if not cost["pairs"]:
        return "in no pair of runs"
    said = (
        f"{cost['mine']:.1f} and {cost['other']:.1f} in {cost['pairs']} pairs, difference "
        f"{cost['difference']:+.1f} ({cost['difference_low']:+.1f} to {cost['difference_high']:+.1f})"
    )
    if cost["share"] is None:
        return said
    within = "not bounded" if cost["low"] is None else f"{cost['low']:.2f} to {cost['high']:.2f}"
    return f"{said}, ratio {cost['share']:.2f} ({within})"


def _noise_table(experiments: Sequence[Results]) -> str:
    """A row a disturbance and method: rule and main task."""
    ranked = sorted(experiments, key=lambda r: DISTURBANCES.index(r["experiment"]["noise"]))
    rows = [
        (
            results["experiment"]["noise"],
            one["method"],
            share(one["satisfied"]),
            share(one["main_done"]),
            f"{one['kl']:.1f}",
            f"{one['modes'].get('fallback', 0) + one['modes'].get('violated', 0)} of "
            f"{sum(one['modes'].values())}",
            f"{one['residual']:.3f}",
        )
        for results in ranked
        for one in results["methods"]
        if results["experiment"]["noise"] != "none" or split(one["method"])[0] in CERTIFYING
    ]
    heads = (
        "world", "method", "rule satisfied", "main task done", "KL a run [nats]", "fallback or violated",
        "largest surprise [m]",
    )  # fmt: skip
    return markdown(heads, rows)


def _calibrations(found: dict[Path, Results]) -> Iterator[str]:
    lines = []
    for kept, results in found.items():
        path = kept / "calibration.json"
        for made in json.loads(path.read_text()).values() if path.exists() else ():
            runs = [record for record in read(kept) if record.method == made["method"]]
            covered = sum(record.residual <= made["margin"] for record in runs)
            lines.append(
                f"- {results['case']}, {results['experiment']['noise']}, {made['method']}: "
                f"{made['margin']:.4f} m from {made['runs']} other runs; it covered every step of {covered} "
                f"of {len(runs)} runs."
            )
    if lines:
        yield (
            "The margins above come from calibration campaigns (split conformal prediction, alpha 0.05, a "
            "run's largest surprise as its score):"
        )
        yield "\n".join(lines)


def _commands(folder: Path, found: Mapping[Path, Results], page: Path) -> Iterator[str]:
    top = Path("out") / folder.resolve().name
    for kept, results in found.items():
        about, case = results["experiment"], results["case"]
        if about["house"]:
            folder_of = "" if about["house"] == case else f" --houses {Path(about['house']).parent}"
            case = f"house --house {case}{folder_of}"
        out = top / kept.parent.parent.relative_to(folder)
        for runs in dict.fromkeys(one["runs"] for one in results["methods"]):
            methods = ",".join(one["method"] for one in results["methods"] if one["runs"] == runs)
            yield (
                f"specshield evaluate --case {case} --runs {runs} --seed {about['seed']} "
                f"--model {about['model']} --noise {about['noise']} --methods {methods} --out {out}"
            )
    yield f"specshield report {top} --out docs/{page.name}"
