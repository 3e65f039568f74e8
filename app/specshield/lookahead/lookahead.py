"""Look-ahead: inside the feasible set S_t, weigh what the model wants by what it will cost the model later.

Projection lets the model put a visit off, step after step, until the visit is forced. Look-ahead spreads that
force over the path, from the step on at which the rule has cost the model FORCED. Until then it answers as
projection does, so a rule that the model keeps almost by itself costs no more with look-ahead.

It has stand-ins for the model: one for each of some places that the model may be going to, and one that
wanders. Each has a table of D, what the rule will still cost it from every pose in KL and in steps
(desirability.py), which is solved once for a task. A session learns which of the stand-ins the model is like
(belief.py), and each action is weighed by exp(-D), with D the mean over them. Only the preference inside S_t
changes: the rule is kept because of S_t alone.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.linalg import block_diag

from specshield.arrays import Bools, Floats, Ints
from specshield.errors import Unsupported
from specshield.lookahead import belief as beliefs
from specshield.lookahead.belief import STYLE, Belief
from specshield.lookahead.desirability import UNKEEPABLE, solve
from specshield.lookahead.expansion import Bank, expand_all
from specshield.lookahead.goals import Goals, make_goals
from specshield.lookahead.lattice import make_planes
from specshield.lookahead.preferences import AHEADS, PreferenceKind
from specshield.lookahead.surrogate import WANDER, stand_in_for
from specshield.policy.progress import SETTLED, make_rules, replay
from specshield.policy.reachability.policy import ReachabilityPolicy, synthesise
from specshield.portable import exp, inner
from specshield.robot.dynamics import make_body
from specshield.rule.values import signal_rows
from specshield.shield.proposal import Proposer
from specshield.task import Task

# Chosen by hand; what the whole is worth is measured by `specshield evaluate` and benchmarks.told.
LEAD_GAP = 1.0  # [m] along free space between the places that have a table, where that makes few enough
WORK = 200_000_000  # entries that are solved for a task, at most, but for no fewer than FEWEST places
MOST, FEWEST = 64, 8  # places that have a table
REACH = 0.3  # [m] a place this much farther away than the nearest stands for a goal 1 / e as much as that
LEADERS = 16  # tables that a decision reads
FORCED = 1.0  # [nats] of KL that the rule has to have cost before anything is weighed: evaluation/rivals.py
NEGLIGIBLE = 0.02  # a smaller probability, or trust, is not worth the work
WORST = 10.0  # [nats] D of actions that have none, above the worst action that has one


@dataclass(frozen=True, eq=False)
class LookAhead:
    """A task as the look-ahead sees it, prepared once.

    shares [G + 1, B]: how much each stand-in stands for each goal, and for wandering; a row sums to 1.
    """

    task: Task
    bank: Bank
    shares: Floats

    def begin(self) -> bytes:
        return beliefs.begin(len(self.bank.goals.distance), len(self.task.robot.motions)).to_bytes()

    def step(
        self,
        memory: bytes,
        history: Floats,
        signals: Mapping[str, Floats],
        log_prior: Floats,
        feasible: Bools,
    ) -> tuple[bytes, Floats]:
        """As `Preference.step`. The memory is the belief.

        The log-weight of an action is -trust * (D of the pose it leads to - the least such D), so at most 0.
        It is 0 for a terminal action, if nothing is known, until the rule has cost FORCED, and once the rule
        is over.
        """
        if len(memory) != len(begun := self.begin()):  # another version wrote it
            memory = begun
        robot, pose = self.task.robot, history[-1]
        belief = Belief.from_bytes(memory, len(robot.motions))
        prior = exp(log_prior)
        going_on = prior[~robot.terminal]
        if going_on.sum() <= 0.0:  # the model ends for certain: it says nothing of where it would go
            return memory, np.zeros(len(prior))
        said = np.bincount(robot.motion_of[~robot.terminal], going_on, len(robot.motions)) / going_on.sum()
        end = float(prior[robot.terminal].sum())
        possible = float(prior[feasible & ~robot.terminal].sum()) / float(going_on.sum())
        forced = -float(going_on.sum()) * math.log(possible) if possible > 0.0 else FORCED
        belief = beliefs.update(belief, self.bank.goals, pose, said, end, max(forced, 0.0))
        over = len(history) > self.task.horizon  # no motion changes what the rule says
        if over or belief.forced < FORCED or belief.trust < NEGLIGIBLE:
            return belief.to_bytes(), np.zeros(len(prior))
        costs = self._costs(belief, history, signals)
        return belief.to_bytes(), np.where(robot.terminal, 0.0, -belief.trust * costs[robot.motion_of])

    def _costs(self, belief: Belief, history: Floats, signals: Mapping[str, Floats]) -> Floats:
        """D after each motion above the least of them, [M]: the mean over the likely stand-ins."""
        t, bank = len(history) - 1, self.bank
        rules = bank.rules._replace(signals=bank.rules.signals.copy())
        status, _ = replay(rules, rules.margin, history, signal_rows(self.task, signals, t + 1))
        mask = sum(1 << g for g, k in enumerate(bank.planes.goal) if status[k] == SETTLED)
        weights = inner(self.shares.T, belief.probabilities())
        asked = np.argsort(-weights, kind="stable")[:LEADERS]
        asked = asked[weights[asked] >= NEGLIGIBLE]
        costs = np.empty((len(asked), len(self.task.robot.motions)))
        expand_all(bank._replace(rules=rules), asked, STYLE, t, mask, history[-1], costs)
        known = np.all(costs < UNKEEPABLE, axis=0)
        if not known.any():
            return np.zeros(costs.shape[1])
        # Most of D is the cost of bending the model, which is proportional to how sharp the model is.
        sharp = np.where(bank.leads[asked] == WANDER, 1.0, belief.style[0] / STYLE[0])
        total = inner(np.where(known, costs, 0.0).T, weights[asked] / weights[asked].sum() * sharp)
        result: Floats = np.where(known, total - total[known].min(), np.ptp(total[known]) + WORST)
        return result


def prepare(task: Task, proposers: Sequence[Proposer] = ()) -> LookAhead:
    """The look-ahead for a task, from the tables of a reachability policy among `proposers` if there is one.

    A process keeps the last AHEADS. Raises FragmentError outside the fragment, PolicyError or Unsupported for
    a task too large.
    """
    computed = [each for each in proposers if isinstance(each, ReachabilityPolicy)]
    return _prepare(task, computed[0] if computed else None)


@lru_cache(AHEADS)
def _prepare(task: Task, policy: ReachabilityPolicy | None) -> LookAhead:
    body, rules = make_body(task.robot, task.grid), make_rules(task)
    goals = make_goals(body, task.grid)
    if len(goals.distance) == 0:
        told = "look-ahead needs places where the robot can turn freely, and this map has none"
        expected = "'projection'"
        raise Unsupported(told, path="shaping", got="lookahead", expected=expected)
    planes = make_planes(body, rules, task.horizon, (policy or synthesise(task)).tables)
    entries = int((planes.slot >= 0).sum()) * planes.valid.size
    places, shares = _leads(goals, min(max(WORK // entries, FEWEST), MOST))
    leads = np.append(places, WANDER)
    shape = (len(leads), int(planes.kept.max()) + 1, len(planes.valid), int(planes.row.max()) + 1)
    tables = np.empty(shape, np.uint16)
    for table, lead in zip(tables, leads, strict=True):
        table[:] = solve(planes, stand_in_for(goals, planes, int(lead), STYLE))
    return LookAhead(task, Bank(rules, goals, planes, leads, tables), block_diag(shares, 1.0))


PREFERENCE = PreferenceKind(
    "Spreads what the rule will cost the model over the whole path; for the formulas `reachability` takes.",
    prepare,
)


def _leads(goals: Goals, most: int) -> tuple[Ints, Floats]:
    """At most `most` goals that lie apart, [B], and how far each stands for each goal, [G, B]."""
    cells = np.array([np.argwhere(distance == 0)[0] for distance in goals.distance])
    between = goals.distance[:, cells[:, 0], cells[:, 1]].astype(np.float64) / 100.0
    gap = LEAD_GAP
    while True:
        chosen: list[int] = []
        for g in range(len(cells)):
            if np.all(between[chosen, g] >= gap):
                chosen.append(g)
        if len(chosen) <= most:
            further = between[chosen] - between[chosen].min(axis=0)
            near = exp(-further.T / REACH)
            return np.array(chosen), near / near.sum(axis=1, keepdims=True)
        gap *= 1.1
