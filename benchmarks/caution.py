"""What caution costs: a decision's time by a session's defaults, and the nats that time in hand is paid with.

    python -m benchmarks.caution [--episodes 15] [--runs 60] [--seed 0]

Time: the learned model acts in cases 1 and 2, the shield decides, the robot does what is drawn, until the
rule is decided or at its end. Each decision is made three times, and the quickest counts. `none` and
`default` each drive their own episodes. The machine may be shared: compare the two, not the milliseconds.

Nats: the KL of a whole run in the house drawn_3 with `goal-seeker`, by the steps of slack that every deadline
keeps. The robot is exact and known to be, so that nothing but the slack is asked for, with ways that keep it.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from benchmarks.episodes import driven
from benchmarks.timing import quietest, summary
from evaluation.experiment import SESSIONS, Experiment
from evaluation.methods import Shielded
from evaluation.runs import run_by
from evaluation.shipped import shipped
from specshield.episode import Shield, decide, make_shield
from specshield.shield.decision import Config
from specshield.shield.uncertainty import Uncertainty
from specshield.sim.cases import Case, load_case

REPEATS = 3
SETTINGS = {"none": Config(), "default": SESSIONS["default"]}
SLACKS = (0, 2, 4, 8, 12, 20)  # [steps]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--episodes", type=int, default=15, help="of each case and setting")
    parser.add_argument("--runs", type=int, default=60, help="of each slack")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    print("| case | settings | decisions | p50 [ms] | p99 [ms] | mean [ms] |\n|---|---|--:|--:|--:|--:|")
    for name in ("case1", "case2"):
        case = load_case(name)
        for settings, config in SETTINGS.items():
            shield = make_shield([shipped(case, "reachability")], config)
            list(seconds(case, shield, 1, options.seed + 1))  # warm
            found = np.array(list(seconds(case, shield, options.episodes, options.seed)))
            told = summary(found.tolist())
            print(
                f"| {name} | {settings} | {len(found)} | {told['p50']:.3f} | {told['p99']:.3f} "
                f"| {1e3 * found.mean():.3f} |",
                flush=True,
            )
    print("\n| slack [steps] | kept | KL a run [nats] |\n|--:|--:|--:|")
    setting = Experiment("house", house="drawn_3", model="goal-seeker", seed=options.seed).setting
    exact = Config(uncertainty=Uncertainty(0.0, 0.0, 0.0))
    for slack in SLACKS:
        method = Shielded(make_shield(setting.policies, replace(exact, slack=slack)))
        done = [run_by(setting, i, {"slack": method}, [setting.ours])[0] for i in range(options.runs)]
        kept, nats = sum(each.satisfied for each in done), np.mean([each.kl for each in done])
        print(f"| {slack} | {kept} of {options.runs} | {nats:.1f} |", flush=True)


def seconds(case: Case, shield: Shield, episodes: int, seed: int) -> Iterator[float]:
    """What each decision takes while the rule is pending."""
    for poses, logits, over, carry, _ in driven(case, shield, episodes, seed):
        asked = (shield, poses, logits, over, None, carry)
        yield quietest(lambda asked=asked: decide(*asked), REPEATS)


if __name__ == "__main__":
    main()
