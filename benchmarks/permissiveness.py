"""How much of what is feasible the shield allows, and that it allows nothing else.

    python -m benchmarks.permissiveness [--full] [--seed 0]

Recall: of the (history, action) pairs that have a future that keeps the formula, the share that is certified.
Unsound claims: certified pairs whose witness, simulated again step by step and judged by benchmarks/judge.py,
does not keep it. Three tables, in Markdown: small worlds against the exact set (benchmarks/worlds.py); the
cases against tables of half the pitch and a wide beam; episodes of the cases with every witness checked.
Without --full a tenth of the work.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.judge import Judge
from benchmarks.worlds import KINDS, NEAR, SHAPES, explore, make_world, sample
from evaluation.shipped import shipped
from specshield.caution.surprise.barred import NOTHING_BARRED
from specshield.episode import Config, Decision, Shield, decide, make_shield, start
from specshield.errors import InfeasibleStart
from specshield.policy.dqn.environment import free_poses
from specshield.policy.progress import make_rules, replay
from specshield.policy.reachability.guide import make_scratch
from specshield.policy.reachability.method import Settings
from specshield.policy.reachability.policy import ReachabilityPolicy, synthesise
from specshield.policy.reachability.tables import Guide, slack
from specshield.robot.dynamics import Body, in_collision, motion_count, simulate, step
from specshield.shield.proposal import Proposer
from specshield.sim.cases import Case, case_names, load_case
from specshield.sim.model import GoalSeeker
from specshield.sim.robot import SimulatedRobot

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
REFERENCE = Settings(pitch=0.05, beam=64)


def certified(policy: Proposer, body: Body, judge: Judge, history: Floats) -> Bools:
    """[M]: the motions with a continuation that keeps the formula, simulated anew."""
    motions = policy.propose(history, {}, 0.0).motions
    return judge.keeps(trajectories(body, history, motions))


def trajectories(body: Body, history: Floats, motions: NDArray[np.int64]) -> Floats:
    """The history, then each row of motions [N, T - t]: [N, T + 1, 3]."""
    out = np.empty((len(motions), len(history) + motions.shape[1], 3))
    out[:, : len(history)] = history
    for row, joined in zip(motions, out, strict=True):
        simulate(body, history[-1], row, joined[len(history) :])
    return out


# Small worlds


def small_worlds(worlds: int, states: int, seed: int) -> Iterator[str]:
    """A row a kind and shape: recall of the shield against the exact set, and what it claims beyond it."""
    yield (
        f"| world | formula | worlds | states | at most {NEAR} steps of slack | feasible pairs | recall "
        "| recall, little slack | unsound |"
    )
    yield "|---|---|---|---|---|---|---|---|---|"
    total = np.zeros((2, 3), int)  # [slack > NEAR, slack <= NEAR] x [feasible, certified, unsound]
    for kind in KINDS:
        for shape in SHAPES:
            counts, seen, kept = np.zeros((2, 3), int), Counter[bool](), 0
            for number in range(20 * worlds):
                if kept == worlds:
                    break
                world = make_world(kind, shape, 1000 * seed + number)
                exact = explore(world)
                if exact is None:
                    continue
                kept += 1
                policy = synthesise(world.task, Settings(pitch=kind.pitch))
                body, judge = make_shield([policy]).body, Judge(str(world.task.formula), world.regions)
                wait, random = world.task.robot.wait_motion, np.random.default_rng([seed, number])
                for t, key, spare in sample(exact, wait, states, random):
                    claimed = certified(policy, body, judge, exact.history(t, key))
                    true, near = exact.feasible(t, key), int(spare <= NEAR)
                    seen[spare <= NEAR] += 1
                    counts[near] += int(true.sum()), int((true & claimed).sum()), int((claimed & ~true).sum())
            total += counts
            yield (
                f"| {kind.name} | {shape} | {kept} | {seen.total()} | {seen[True]} | {counts[:, 0].sum()} "
                f"| {_share(*counts.sum(axis=0)[:2])} | {_share(*counts[1, :2])} | {counts[:, 2].sum()} |"
            )
    yield (
        f"| all | | | | | {total[:, 0].sum()} | {_share(*total.sum(axis=0)[:2])} | {_share(*total[1, :2])} "
        f"| {total[:, 2].sum()} |"
    )


def _share(whole: int, part: int) -> str:
    return f"{part / whole:.4f}" if whole else "-"


# The cases


class Slack:
    """Steps to spare by a policy's tables."""

    def __init__(self, policy: ReachabilityPolicy, body: Body) -> None:
        wait = policy.task.robot.wait_motion
        self.guide = Guide(body, make_rules(policy.task), policy.tables, wait, NOTHING_BARRED)
        self.scratch = make_scratch(self.guide.rules, motion_count(body))

    def here(self, history: Floats) -> float:
        rules, scratch = self.guide.rules, self.scratch
        progress = replay(rules, rules.margin, history, np.empty((len(history), 0)))
        scratch.status[:], scratch.run[:] = progress
        x, y, theta = history[-1].tolist()
        return float(slack(self.guide, x, y, theta, len(history) - 1, scratch))

    def after(self, history: Floats) -> Floats:
        """[M]: after each motion from x_t."""
        x, y, theta = history[-1].tolist()
        after = [step(self.guide.body, x, y, theta, m) for m in range(motion_count(self.guide.body))]
        return np.array([self.here(np.concatenate([history, [pose]])) for pose in after])


class Model:
    """A prior for one episode: noise, all but standing still, giving slack away, or the stand-in model."""

    NAMES = ("noise", "idle", "adversary", "seeker")

    def __init__(self, case: Case, spare: Slack, kind: str, random: np.random.Generator) -> None:
        self.kind, self.random, self.spare, self.robot = kind, random, spare, case.task.robot
        self.sim = SimulatedRobot(case, (0.0, 0.0, 0.0))
        self.wants = random.normal(size=len(self.robot.actions)) * random.choice([0.0, 1.0, 3.0])
        self.seeker = GoalSeeker(case.task.robot)
        self.seeker.reset(random)

    def logits(self, history: Floats) -> Floats:
        end = self.robot.terminal
        if self.kind == "seeker":
            x, y, theta = history[-1].tolist()
            self.sim.pose = (x, y, theta)
            return self.seeker.logits(self.sim)
        noise = self.random.normal(size=len(end))
        if self.kind == "adversary":
            low = 30.0 * np.clip(self.spare.after(history), -5.0, 40.0)
            return np.where(end, -1e4, noise - low[self.robot.motion_of])
        if self.kind == "idle":
            noise = noise + 8.0 * (self.robot.motion_of == self.robot.wait_motion)
        return np.where(end, -9.0, noise + self.wants)


@dataclass
class Outcome:
    """What came of one episode; pairs: (history, motion) that were judged, claims: those certified."""

    kept: bool
    modes: Counter[str]
    pairs: int = 0
    claims: int = 0
    unsound: int = 0
    infeasible: int = 0


def episode(
    shield: Shield, case: Case, judge: Judge, model: Model, pose: Floats, random: np.random.Generator
) -> Outcome:
    """One episode without mismatch; every witness of every decision is simulated and judged anew."""
    terminal = case.task.robot.terminal
    history, out, over, decision = [pose], Outcome(False, Counter()), False, None
    while len(history) <= case.task.horizon:
        past = np.array(history)
        decision = decide(
            shield,
            past,
            None if over else model.logits(past),
            over,
            carry=None if decision is None else decision.carry,
        )
        out.modes[decision.mode] += 1
        if decision.completion_action is None:
            break
        _check(out, shield, judge, past, decision)
        action = int(random.choice(len(terminal), p=decision.distribution))
        if terminal[action]:
            over, action = True, decision.completion_action
        history.append(decision.next_poses[action])
    rest = np.tile(history[-1], (case.task.horizon + 1 - len(history), 1))
    whole = np.concatenate([np.array(history), rest])[None]
    out.kept = bool(judge.keeps(whole)[0]) and not any(in_collision(shield.body, *p) for p in history)
    return out


def _check(out: Outcome, shield: Shield, judge: Judge, past: Floats, decision: Decision) -> None:
    claimed = [
        np.frombuffer(bytes([m]) + found, np.uint8).astype(np.int64)
        for m, found in enumerate(decision.carry.witnesses)
        if found is not None
    ]
    out.pairs += len(decision.carry.witnesses)
    out.claims += len(claimed)
    out.infeasible += not claimed
    if claimed:
        rows = np.array(claimed)
        out.unsound += len(rows) - int(judge.keeps(trajectories(shield.body, past, rows)).sum())


def campaign(case: Case, policies: Sequence[Any], tables: ReachabilityPolicy, n: int, seed: int) -> str:
    """A row: n episodes from feasible starts, the i-th decided by seed and i alone."""
    shield = make_shield(list(policies), Config(seed=seed))
    judge = Judge(str(case.task.formula), case.spec["regions"])
    began = time.perf_counter()

    def one(i: int) -> tuple[Outcome, int]:
        random = np.random.default_rng([seed, i, 5])
        for refused, pose in enumerate(free_poses(case.task, shield.body, 200, random)):
            try:
                start(shield, pose)
            except InfeasibleStart:
                continue
            model = Model(case, Slack(tables, shield.body), Model.NAMES[i % 4], random)
            return episode(shield, case, judge, model, pose, random), refused
        raise RuntimeError("no feasible start")

    with ThreadPoolExecutor(2) as threads:
        done = list(threads.map(one, range(n)))
    ran = [outcome for outcome, _ in done]
    modes = sum((o.modes for o in ran), Counter[str]())
    return (
        f"| {case.name} | {' + '.join(p.card['method'] for p in policies)} | {n} | {sum(r for _, r in done)} "
        f"| {sum(o.kept for o in ran)} | {modes['fallback']} | {modes['violated']} "
        f"| {sum(o.infeasible for o in ran)} | {modes.total()} | {sum(o.pairs for o in ran)} "
        f"| {sum(o.claims for o in ran)} | {sum(o.unsound for o in ran)} "
        f"| {time.perf_counter() - began:.0f} |"
    )


def states_on_the_way(
    case: Case, tables: ReachabilityPolicy, n: int, seed: int
) -> Iterator[tuple[Floats, bool]]:
    """n histories met in shielded episodes, at most one in four steps of one, half with little slack."""
    shield = make_shield([tables], Config(seed=seed))
    spare, left = Slack(tables, shield.body), {True: n // 2, False: n - n // 2}
    for i in range(100 * n):
        random = np.random.default_rng([seed, i, 6])
        pose = free_poses(case.task, shield.body, 1, random)[0]
        kind = ("adversary", "adversary", "idle", "noise")[i % 4]
        model, history, decision = Model(case, spare, kind, random), [pose], None
        while len(history) <= case.task.horizon:
            past = np.array(history)
            here = spare.here(past)
            near = here <= NEAR
            if here < -3.0 or sum(left.values()) == 0:
                break
            if random.random() < 0.25 and left[near] > 0:
                left[near] -= 1
                yield past, near
            decision = decide(
                shield, past, model.logits(past), carry=None if decision is None else decision.carry
            )
            if decision.completion_action is None:
                break
            action = int(random.choice(len(decision.distribution), p=decision.distribution))
            if case.task.robot.terminal[action]:
                action = decision.completion_action
            history.append(decision.next_poses[action])
        if sum(left.values()) == 0:
            return


def against_reference(case: Case, n: int, seed: int) -> Iterator[str]:
    """Rows: the recall of each method against all that any of them or the reference certifies."""
    ours, dqn, fine = synthesise(case.task), shipped(case, "dqn"), synthesise(case.task, REFERENCE)
    body = make_shield([ours]).body
    judge = Judge(str(case.task.formula), case.spec["regions"])
    fine_slack = Slack(fine, body)
    found: dict[str, list[tuple[bool, Bools]]] = {"reachability": [], "dqn": [], "reference": []}
    for history, _ in states_on_the_way(case, ours, n, seed):
        near = fine_slack.here(history) <= NEAR
        for name, policy in (("reachability", ours), ("dqn", dqn), ("reference", fine)):
            found[name].append((near, certified(policy, body, judge, history)))
    nears = np.array([near for near, _ in found["dqn"]])
    claims = {name: np.array([claim for _, claim in rows]) for name, rows in found.items()}
    claims["dqn + reachability"] = claims["dqn"] | claims["reachability"]
    truth = claims["reference"] | claims["dqn + reachability"]
    for name in ("dqn", "reachability", "dqn + reachability", "reference"):
        got = claims[name]
        cells = [
            _share(int(truth[which].sum()), int(got[which].sum())) for which in (nears >= 0, nears, ~nears)
        ]
        yield (
            f"| {case.name} | {name} | {len(nears)} | {int(nears.sum())} | {int(truth.sum())} "
            f"| {' | '.join(cells)} |"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description="Recall and soundness of the feasible set, as Markdown.")
    parser.add_argument("--full", action="store_true")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--part", choices=("worlds", "reference", "episodes"), help="one table alone")
    parser.add_argument("--case", choices=case_names(), help="one case alone")
    asked = parser.parse_args()
    cases = [load_case(name) for name in ([asked.case] if asked.case else case_names())]
    share, seed = (1.0 if asked.full else 0.1), asked.seed
    print(f"# Permissiveness (seed {seed}, {'full' if asked.full else 'quick'})\n", flush=True)
    if asked.part in (None, "worlds"):
        print("## Small worlds, against every future\n")
        for row in small_worlds(max(int(20 * share), 2), 60, seed):
            print(row, flush=True)
    if asked.part in (None, "reference"):
        print(f"\n## The cases, against pitch {REFERENCE.pitch} m and a beam of {REFERENCE.beam}\n")
        print(
            f"| case | certified by | states | at most {NEAR} steps of slack | feasible pairs | recall "
            "| little slack | more |\n|---|---|---|---|---|---|---|---|"
        )
        for case in cases:
            for row in against_reference(case, int(2000 * share), seed):
                print(row, flush=True)
    if asked.part in (None, "episodes"):
        print("\n## Episodes without mismatch, every witness checked\n")
        print(
            "| case | policies | episodes | starts refused | kept | fallback | violated | nothing certified "
            "| decisions | pairs | certified | unsound | s |\n|---" + "|---" * 12 + "|"
        )
        for case in cases:
            tables = synthesise(case.task)
            print(campaign(case, [tables], tables, int(1000 * share), seed), flush=True)
            print(campaign(case, [shipped(case, "dqn"), tables], tables, int(100 * share), seed), flush=True)


if __name__ == "__main__":
    main()
