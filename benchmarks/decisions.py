"""One decision by each of the four, on the same states: (a), (b), (c), (d)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from benchmarks.plain import Plain
from benchmarks.states import State, along, shipped_dqn, starts
from benchmarks.timing import quietest, summary
from specshield.policy import reachability
from specshield.shield.episode import Shield, decide, make_shield
from specshield.shield.feasibility import futures, rho
from specshield.shield.shaping import log_softmax, restrict
from specshield.sim.cases import load_case
from specshield.stl import SATISFIED_ABOVE, robustness_bounds

ROUNDING = 1e-9  # [m] how far rho may differ between two programs that compute the same
NAMES = {
    "a": "the paper's algorithm, action by action",
    "b": "the same, batched over the actions",
    "c": "specshield, the shipped DQN",
    "d": "specshield, reachability",
}


def compare(
    case_name: str, n: int, episodes: int, plain_states: int, repeats: int, seed: int
) -> dict[str, Any]:
    """Times of all four at t = 0 and along episodes, where they disagree, where (c) and (d) spend time."""
    case = load_case(case_name)
    shields = {"c": make_shield([shipped_dqn(case)]), "d": make_shield([reachability.synthesise(case.task)])}
    plain = Plain(shipped_dqn(case))
    result: dict[str, Any] = {"agreement": {}}
    for place in ("start", "along"):
        times: dict[str, list[float]] = {}
        raw: dict[str, list[float]] = {}
        for key, shield in shields.items():
            states = starts(shield, n, seed) if place == "start" else along(case, shield, episodes, seed)
            warm(shield, states[0])
            raw[key] = [ask(shield, state, 1) for state in states]
            times[key] = [ask(shield, state, repeats) for state in states]
            result.setdefault("parts", {}).setdefault(place, {})[key] = parts(shield, states[:60], repeats)
            if key == "c":
                chosen = spread(states, plain_states)
        few = chosen[: max(len(chosen) // 3, 2)]
        times["a"] = [quietest(lambda s=s: plainly(plain.one_by_one, s), 1) for s in few]
        times["b"] = [quietest(lambda s=s: plainly(plain.batched, s), 2) for s in chosen]
        result[place] = {key: summary(times[key]) for key in sorted(times)}
        result[f"{place}_once"] = {key: summary(seconds) for key, seconds in raw.items()}
        result["agreement"][place] = agreement(plain, shields["c"], chosen, few)
    return result


def ask(shield: Shield, state: State, repeats: int) -> float:
    over = state.logits is None
    return quietest(lambda: decide(shield, state.history, state.logits, over, carry=state.carry), repeats)


def warm(shield: Shield, state: State) -> None:
    for _ in range(3):
        ask(shield, state, 1)


def plainly(values_of: Any, state: State) -> np.ndarray | None:
    """Algorithm 1's answer out of rho of each action."""
    feasible = values_of(state.history) > SATISFIED_ABOVE
    return None if state.logits is None else restrict(log_softmax(state.logits), feasible)


def agreement(plain: Plain, ours: Shield, states: Sequence[State], few: Sequence[State]) -> dict[str, Any]:
    """Pairs (state, action) on which J of (a) or (b) is not that of (c), and the largest difference in rho.

    A witness carried would only add to S_t, so (c) decides without one here. float32 sums may be ordered in
    another way, so a rollout may in principle part from ours where two Q-values are as good as equal: that is
    counted (`parted`), and J has to be equal in every other.
    """
    going = ~plain.task.robot.terminal
    count: Counter[str] = Counter()
    largest = 0.0
    for key, among, values_of in (("a", few, plain.one_by_one), ("b", states, plain.batched)):
        for state in among:
            decision = decide(ours, state.history, np.zeros(len(going)))
            if decision.spec_status != "pending":
                continue
            mine = np.array(decision.robustness, dtype=np.float64)[going]
            theirs = values_of(state.history)[going]
            parted = np.abs(mine - theirs) > ROUNDING
            differs = (mine > SATISFIED_ABOVE) != (theirs > SATISFIED_ABOVE)
            assert not np.any(differs & ~parted), f"({key}) and (c) disagree on J at t = {state.t}"
            count["pairs"] += len(mine)
            count["parted"] += int(parted.sum())
            count["j_differs"] += int(differs.sum())
            largest = max(largest, float(np.abs(mine - theirs)[~parted].max(initial=0.0)))
    return {
        "pairs": count["pairs"],
        "parted": count["parted"],
        "j_differs": count["j_differs"],
        "rho": largest,
    }


def parts(shield: Shield, states: Sequence[State], repeats: int) -> dict[str, float]:
    """Median milliseconds of a decision's parts: the policy's continuations, their robustness, the rest."""
    task, policy = shield.task, shield.policies[0]
    total, proposing, judging, prefixing = [], [], [], []
    for state in states:
        tried = futures(task, shield.body, shield.policies, state.history, {}, None, 0.0)
        total.append(ask(shield, state, repeats))
        proposing.append(quietest(lambda s=state: policy.propose(s.history, {}, 0.0), repeats))
        judging.append(quietest(lambda f=tried: rho(task, task.formula, f, {}), repeats))
        prefixing.append(
            quietest(lambda s=state: robustness_bounds(task.formula, task.samples(s.history)), repeats)
        )
    medians = {
        "decide": total, "policy.propose": proposing, "robustness of the futures": judging,
        "bounds of the prefix": prefixing,
    }  # fmt: skip
    result = {name: 1e3 * float(np.median(values)) for name, values in medians.items()}
    result["the rest"] = 2 * result["decide"] - sum(result.values())
    return result


def spread(states: Sequence[State], n: int) -> list[State]:
    return [states[i] for i in np.unique(np.linspace(0, len(states) - 1, n).astype(int))]
