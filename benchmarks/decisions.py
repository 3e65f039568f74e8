"""One decision by each of the four, on the same states: (a), (b), (c), (d)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from benchmarks.plain import Plain
from benchmarks.states import Floats, State, along, shipped_dqn, starts
from benchmarks.timing import quietest, summary
from specshield.episode import Shield, decide, make_shield
from specshield.policy.reachability import policy as reachability
from specshield.shield.feasibility import futures, prefix_of, simulated
from specshield.shield.shaping import log_softmax, restrict
from specshield.sim.cases import load_case
from specshield.stl import SATISFIED_ABOVE

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
    literal = make_shield([replace(shipped_dqn(case), literal=True)])
    shields = {"c": make_shield([shipped_dqn(case)]), "d": make_shield([reachability.synthesise(case.task)])}
    plain = Plain(shipped_dqn(case))
    result: dict[str, Any] = {}
    for place in ("start", "along"):
        here: dict[str, Any] = {"once": {}, "parts": {}}
        for key, shield in shields.items():
            states = starts(shield, n, seed) if place == "start" else along(case, shield, episodes, seed)
            warm(shield, states[0])
            here["once"][key] = summary([ask(shield, state, 1) for state in states])
            here[key] = summary([ask(shield, state, repeats) for state in states])
            here["parts"][key] = parts(shield, states[:60], repeats)
            if key == "c":
                chosen = spread(states, plain_states)
        result[place] = here | beside(plain, shields, literal, chosen, repeats)
    return result


def beside(
    plain: Plain, shields: Mapping[str, Shield], literal: Shield, states: Sequence[State], repeats: int
) -> dict[str, Any]:
    """(a) and (b) on a few states, how many times longer they take than (c) and (d), whether J agrees."""
    times: dict[str, list[float]] = {key: [] for key in "abcd"}
    found = Agreement()
    for state in states:
        for key, shield in shields.items():
            times[key].append(ask(shield, state, repeats))
        for key, values_of in (("a", plain.one_by_one), ("b", plain.batched)):
            times[key].append(quietest(lambda s=state, v=values_of: plainly(v, s), repeats))
            found.add(literal, shields["c"], state, values_of(state.history))
    ratios = {
        f"{plain_key}/{ours}": float(np.median(np.array(times[plain_key]) / times[ours]))
        for plain_key in "ab"
        for ours in "cd"
    }
    return {"a": summary(times["a"]), "b": summary(times["b"]), "ratios": ratios, "agreement": vars(found)}


def plainly(values_of: Callable[[Floats], Floats], state: State) -> Floats | None:
    """Algorithm 1's answer out of rho of each action."""
    feasible = values_of(state.history) > SATISFIED_ABOVE
    return None if state.logits is None else restrict(log_softmax(state.logits), feasible)


@dataclass
class Agreement:
    """J of (a) and (b) against that of (c) with `literal` rollouts, over pairs of state and action.

    satisfied: pairs with J = 1. more: pairs with J = 1 in (c) as it is, which may undo a motion and go on,
    and 0 with `literal` rollouts; never the reverse. rho: the largest difference in robustness [m]. A witness
    carried would only add to S_t, so (c) decides without one here. float32 sums may be ordered in another
    way, so a rollout may in principle part from ours where two Q-values are as good as equal: `parted`;
    elsewhere J has to agree.
    """

    pairs: int = 0
    satisfied: int = 0
    more: int = 0
    parted: int = 0
    differ: int = 0
    rho: float = 0.0

    def add(self, literal: Shield, ours: Shield, state: State, values: Floats) -> None:
        """values: rho of each action, [A]. Raises AssertionError where J differs without a reason."""
        going = ~ours.task.robot.terminal
        logits = np.zeros(len(going))
        decision = decide(literal, state.history, logits)
        mine, theirs = np.array(decision.robustness, dtype=np.float64)[going], values[going]
        shipped = np.array(decide(ours, state.history, logits).robustness, dtype=np.float64)[going]
        lost = (mine > SATISFIED_ABOVE) & ~(shipped > SATISFIED_ABOVE)
        assert not lost.any(), f"J = 1 with literal rollouts alone at t = {state.t}: {mine} and {shipped}"
        parted = np.abs(mine - theirs) > ROUNDING
        differ = (mine > SATISFIED_ABOVE) != (theirs > SATISFIED_ABOVE)
        assert not np.any(differ & ~parted), f"J differs at t = {state.t}: {mine} and {theirs}"
        self.pairs += len(mine)
        self.satisfied += int((mine > SATISFIED_ABOVE).sum())
        self.more += int(((shipped > SATISFIED_ABOVE) & ~(mine > SATISFIED_ABOVE)).sum())
        self.parted += int(parted.sum())
        self.differ += int(differ.sum())
        self.rho = max(self.rho, float(np.abs(mine - theirs)[~parted].max(initial=0.0)))


def ask(shield: Shield, state: State, repeats: int) -> float:
    over = state.logits is None
    return quietest(lambda: decide(shield, state.history, state.logits, over, carry=state.carry), repeats)


def warm(shield: Shield, state: State) -> None:
    for _ in range(3):
        ask(shield, state, 1)


def parts(shield: Shield, states: Sequence[State], repeats: int) -> dict[str, float]:
    """Median milliseconds of a decision's parts: the policy's continuations, their robustness, the rest."""
    task, policy = shield.task, shield.proposers[0]
    total, proposing, judging, prefixing = [], [], [], []
    for state in states:
        prefix = prefix_of(task, task.formula, shield.view, state.history, {})
        tried = futures(prefix, shield.body, shield.proposers, None, (0.0,))
        total.append(ask(shield, state, repeats))
        proposing.append(quietest(lambda s=state: policy.propose(s.history, {}, 0.0), repeats))
        judging.append(quietest(lambda p=prefix, f=tried: simulated(p, shield.body, [f.motions], 0), repeats))
        prefixing.append(
            quietest(lambda s=state: prefix_of(task, task.formula, shield.view, s.history, {}), repeats)
        )
    medians = {
        "decide": total, "policy.propose": proposing, "simulating and judging the futures": judging,
        "bounds of the prefix": prefixing,
    }  # fmt: skip
    result = {name: 1e3 * float(np.median(values)) for name, values in medians.items()}
    result["the rest"] = 2 * result["decide"] - sum(result.values())
    return result


def spread(states: Sequence[State], n: int) -> list[State]:
    return [states[i] for i in np.unique(np.linspace(0, len(states) - 1, n).astype(int))]
