"""Networks trained with each reward, seed by seed: what they do alone and under the paper's decision rule."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

from evaluation.evaluation import add_lines, finished
from evaluation.experiment import Experiment
from evaluation.methods import Shielded
from evaluation.results import markdown
from evaluation.runs import Record, run_by
from evaluation.statistics import clopper_pearson, mean_of
from specshield.commands.train import train
from specshield.episode import Shield, make_shield, start
from specshield.errors import InfeasibleStart
from specshield.policy.dqn.policy import Policy, load_dqn
from specshield.policy.reachability.policy import synthesise
from specshield.shipped import MODELS
from specshield.sim.cases import case_name, case_names, load_case
from specshield.sim.robot import Pose

REWARDS = {
    "paper": "the paper's: eq. 5 with the funnels of its Table I, to the letter but for what it leaves open",
    "progress": "ours, with which the shipped networks were trained",
}
INTRODUCTION = """\
# Two rewards for the learned policy

Written by `python -m evaluation rewards`. Only the reward differs; what the network sees and how it learns
is the same. All other settings are the defaults; the number of updates is in the table (16,000 by default):

{rewards}

`app/specshield/policy/dqn/funnel.py` says what the paper leaves open, and what was chosen.

- **alone**: the network's greedy policy from {starts} starts uniform over free space.
- **can start**: of the same starts, from how many some first action, and then the policy, keeps the rule. A
  session opens only there.
- **paper's rule**: runs by the paper's decision rule, which is Algorithm 1 with hard projection and this
  network alone, rolled out literally after every action; the model is `learned`. They begin where
  `reachability` finds that the rule can be kept; no start is refused for the network's sake.
- **KL**: the mean over those runs [nats].

Shares have 95 % Clopper-Pearson intervals. Training times are of two cores with other work on them."""
OUTCOME = """\
Of {began} of these runs that began where a session opens with the network, {kept} kept the rule, as
Proposition 1 says, whatever the reward. What a reward decides is from how many places a session opens."""


@dataclass(frozen=True)
class Training:
    """case: a name of sim/cases.py. updates: of the option of that name; all else is by default."""

    case: str
    reward: str
    seed: int
    updates: int

    def folder(self, out: Path) -> Path:
        return out / f"{self.case}-{self.reward}-{self.seed}-{self.updates}"

    def policy(self, out: Path) -> Policy:
        """The network in `out`; trained if it is not there, from where a training was cut off."""
        folder = self.folder(out)
        if not (folder / "card.json").exists():
            options = [f"reward={self.reward}"]
            train(self.case, "dqn", self.seed, self.updates, options, folder, True)
        card = json.loads((folder / "card.json").read_text())
        return load_dqn(folder / "policy.safetensors", card, load_case(self.case).task)

    def shield(self, out: Path) -> Shield:
        """The paper's, with this network."""
        return make_shield([replace(self.policy(out), literal=True)])

    def records(self, out: Path, runs: int) -> list[Record]:
        """Runs 0 to `runs` - 1 by the paper's decision rule with the network; what `out` holds is kept."""
        file = self.folder(out) / "runs.jsonl"
        done = finished(file, Record.from_json)
        setting, method = Experiment(self.case).setting, Shielded(self.shield(out), carries=False)
        for i in range(len(done), runs):
            done += run_by(setting, i, {"paper": method}, [_keeping(self.case)])
            add_lines(file, [done[-1].to_json()])
        return done[:runs]


@dataclass(frozen=True)
class Found:
    """What came of a training: its card's metrics, its runs, and whether a session opens where each began."""

    training: Training
    metrics: dict[str, Any]
    runs: list[Record]
    opened: list[bool]


@lru_cache
def _keeping(case: str) -> Shield:
    """A shield that refuses the starts from which the rule cannot be kept."""
    return make_shield([synthesise(load_case(case).task)])


def compare(trainings: Sequence[Training], runs: int, out: Path, page: Path) -> None:
    """Trains what `out` has not got yet, one after another; writes the page of all that it has after each."""
    for each in trainings:
        each.policy(out)
        found = [_found(made, runs, out) for made in _made(out)]
        page.write_text(text(found, runs, out))


def _made(out: Path) -> list[Training]:
    """The trainings that are finished in `out`: by case, reward, updates and seed."""
    names = [card.parent.name.split("-") for card in out.glob("*/card.json")]
    made = [Training(case, reward, int(seed), int(updates)) for case, reward, seed, updates in names]
    return sorted(made, key=lambda each: (each.case, each.reward, each.updates, each.seed))


def _found(made: Training, runs: int, out: Path) -> Found:
    records, shield = made.records(out, runs), made.shield(out)
    opened = [_opens(shield, record.start) for record in records]
    return Found(made, made.policy(out).card["metrics"], records, opened)


def _opens(shield: Shield, pose: Pose) -> bool:
    try:
        start(shield, pose)
    except InfeasibleStart:
        return False
    return True


def text(found: Sequence[Found], runs: int, out: Path) -> str:
    """The page."""
    heads = (
        "case", "reward", "seed", "updates", "alone", "can start", "training", "paper's rule: kept",
        "main task done", "KL",
    )  # fmt: skip
    rows = [_row(each) for each in found]
    rewards = "\n".join(f"- **{name}**: {said}." for name, said in REWARDS.items())
    starts = max(each.metrics["starts"] for each in found)
    opened = [r.satisfied for each in found for r, opens in zip(each.runs, each.opened, strict=True) if opens]
    parts = [
        INTRODUCTION.format(rewards=rewards, starts=f"{starts:,}", runs=runs),
        markdown(heads, rows),
        "\n".join([*_told(found), *_shipped()]),
        OUTCOME.format(began=len(opened), kept=sum(opened)),
        "```sh\n{}\n```".format("\n".join(_commands([each.training for each in found], runs, out))),
    ]
    return "\n\n".join(parts) + "\n"


def _row(one: Found) -> tuple[str, ...]:
    kept, done = ([getattr(run, name) for run in one.runs] for name in ("satisfied", "main_done"))
    starts = one.metrics["starts"]
    return (
        one.training.case,
        one.training.reward,
        str(one.training.seed),
        f"{one.training.updates:,}",
        _percent(round(one.metrics["satisfied"] * starts), starts),
        _percent(round(one.metrics["feasible_start"] * starts), starts),
        f"{one.metrics['wall_time_s'] / 60:.1f} min",
        _percent(sum(kept), len(kept)),
        _percent(sum(done), len(done)),
        "{mean:.0f} ({low:.0f} to {high:.0f})".format(**mean_of([run.kl for run in one.runs])),
    )


def _percent(count: int, of: int) -> str:
    low, high = clopper_pearson(count, of)
    return f"{100 * count / of:.1f} % ({100 * low:.1f} to {100 * high:.1f})"


def _told(found: Sequence[Found]) -> Iterator[str]:
    """A sentence for each case, reward and number of updates: the range over the seeds."""
    alike = [(each.training.case, each.training.reward, each.training.updates) for each in found]
    for case, reward, updates in dict.fromkeys(alike):
        of = [each for each, is_of in zip(found, alike, strict=True) if is_of == (case, reward, updates)]
        alone, can = (_range([each.metrics[name] for each in of]) for name in ("satisfied", "feasible_start"))
        kept = _range([sum(run.satisfied for run in each.runs) / len(each.runs) for each in of])
        seeds = ", ".join(str(each.training.seed) for each in of)
        yield (
            f"- {case}, `{reward}`, {updates:,} updates, seed {seeds}: alone it keeps the rule from "
            f"{alone} of the starts, a session can open at {can}, and the paper's decision rule keeps {kept} "
            "of its runs."
        )


def _shipped() -> Iterator[str]:
    """What the cards of the networks that are shipped say of the same measurement."""
    for name in case_names():
        card = json.loads((MODELS / f"{name}-dqn" / "card.json").read_text())
        metrics, options = card["metrics"], card["options"]
        yield (
            f"- The network shipped for {name} (`{options['reward']}`, {options['updates']:,} updates, "
            f"seed {card['seed']}): alone from {100 * metrics['satisfied']:.1f} % of {metrics['starts']:,} "
            f"starts, a session can open at {100 * metrics['feasible_start']:.1f} %. It was trained by "
            "earlier code: the same settings and seed need not lead to the same network today."
        )


def _range(shares: Sequence[float]) -> str:
    low, high = (f"{100 * share:.1f}" for share in (min(shares), max(shares)))
    return f"{low} %" if low == high else f"{low} to {high} %"


def _commands(trainings: Sequence[Training], runs: int, out: Path) -> Iterator[str]:
    for case, updates in dict.fromkeys((each.case, each.updates) for each in trainings):
        of = [each for each in trainings if (each.case, each.updates) == (case, updates)]
        rewards = ",".join(dict.fromkeys(each.reward for each in of))
        seeds = ",".join(str(seed) for seed in sorted({each.seed for each in of}))
        yield (
            f"python -m evaluation rewards --case {case} --reward {rewards} --seeds {seeds} "
            f"--updates {updates} --runs {runs} --out out/{out.name}"
        )


def all_of(cases: str, rewards: str, seeds: Sequence[int], updates: int) -> list[Training]:
    """One training for each case, reward (both separated by commas) and seed; the first seed comes first."""
    return [
        Training(case_name(case), reward, seed, updates)
        for seed in seeds
        for case in cases.split(",")
        for reward in rewards.split(",")
    ]
