"""What a session has learned of its model: where it goes, how sharply, and how far that can be trusted.

Each goal is charged the KL of what the model said from what the surrogate (surrogate.py) would have said for
it. The look-ahead weighs by how much better the goals have predicted the model than its own habits have, so
that with a model it cannot know it vanishes.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from specshield.compiled import kernel
from specshield.robot.unicycle import Body
from specshield.shield.surrogate import FEATURES, Goals, cell_of, describe, end_chance, react

Floats = NDArray[np.float64]

STYLE = np.array([2.0, 2.0, -2.0, -1.0])  # of an unknown model: the logit of each feature
SURE = 3.0  # observations that STYLE counts for
KEEP = 0.97  # of a goal's charges from one step to the next: models change their minds
TRACK = 0.95  # of the record of predictions, likewise
HABITS = 0.1  # how fast the running average of the model's motions follows
SHARP = 20.0  # a KL is charged for a whole distribution, which tells more than one draw from it would
POSSIBLE = 0.03  # of the leading goal's probability: goals below that are left out
PATIENCE = 6  # steps, at least, before a plan is made anew
CHANGE = 0.3  # of the goals' probability that has moved since the plan
FLOOR = 0.03  # of the surrogate's mass is spread over all motions: no observation rules a goal out
LEAST = 1e-6  # of a motion's probability
STEEPEST = 4.0  # logits a feature


@dataclass(frozen=True)
class Plan:
    """What the look-ahead goes by until the belief has changed: where to, and how.

    since: the step it was made at. goals: with their probabilities. style [F]: the logit of each feature.
    """

    since: int
    goals: tuple[tuple[int, float], ...]
    style: tuple[float, ...]


@dataclass(frozen=True)
class Belief:
    """cost [G]: each goal's charges [nats]. normal [F, F], moment [F]: of the least squares that fit the
    model's style. habit [M]: running average of the probabilities of its motions. errors: running sums of the
    KL of the model's motions from what the goals, and the habit, predicted. plan: None before any step.
    """

    cost: Floats
    normal: Floats
    moment: Floats
    habit: Floats
    errors: tuple[float, float]
    plan: Plan | None

    @property
    def style(self) -> Floats:
        """The logit of each feature, shape (F,): progress and turning for, in steps of a quarter octave."""
        fitted = np.linalg.solve(self.normal, self.moment)
        sharp = 2.0 ** (round(2.0 * math.log2(min(max(fitted[:2].mean(), 0.5), STEEPEST))) / 2.0)
        return np.array([sharp, sharp, -sharp, round(float(fitted[3]))])

    @property
    def weight(self) -> float:
        """How far the goals can be trusted, 0 to 1: the odds of their prediction to the habit's."""
        lead, habit = self.errors
        return 0.5 * (1.0 + math.tanh(0.5 * (habit - lead)))

    def probabilities(self) -> Floats:
        """Of each goal, 0 for those that hardly can be it. Shape (G,)."""
        odds = np.exp(SHARP * (self.cost.min() - self.cost))
        odds[odds < POSSIBLE] = 0.0
        result: Floats = odds / odds.sum()
        return result

    def to_json(self) -> dict[str, Any]:
        plan = self.plan
        return {
            "cost": self.cost.tolist(),
            "normal": self.normal.tolist(),
            "moment": self.moment.tolist(),
            "habit": self.habit.tolist(),
            "errors": list(self.errors),
            "plan": None if plan is None else [plan.since, [list(g) for g in plan.goals], list(plan.style)],
        }

    @staticmethod
    def from_json(value: Mapping[str, Any]) -> Belief:
        cost, normal, moment, habit = (
            np.array(value[name], dtype=np.float64) for name in ("cost", "normal", "moment", "habit")
        )
        lead, usual = value["errors"]
        plan = None
        if value["plan"] is not None:
            since, goals, style = value["plan"]
            plan = Plan(since, tuple((g, p) for g, p in goals), tuple(style))
        return Belief(cost, normal, moment, habit, (lead, usual), plan)


def begin(goals: int, motions: int) -> Belief:
    """Before the first observation."""
    return Belief(
        np.zeros(goals),
        SURE * np.eye(FEATURES),
        SURE * STYLE,
        np.full(motions, 1.0 / motions),
        (0.0, 0.0),
        None,
    )


def observe(
    belief: Belief,
    body: Body,
    goals: Goals,
    t: int,
    pose: Floats,
    blocked: NDArray[np.bool_],
    said: Floats,
    end: float,
) -> Belief:
    """After what the model said at x_t (3,).

    blocked [M]: motions that something would stop short. said [M]: the motions' probabilities, given that it
    does not end; end: the probability that it does.
    """
    said = np.maximum(said, LEAST) / np.maximum(said, LEAST).sum()
    log_said = np.log(said)
    off, ends_off = np.empty(len(belief.cost)), np.empty(len(belief.cost))
    x, y, theta = (float(v) for v in pose)
    _charge(body, goals, belief.style, x, y, theta, blocked, said, log_said, end, off, ends_off)
    usual = float(said @ (log_said - np.log((1.0 - FLOOR) * belief.habit + FLOOR / len(said))))
    predicted = float(belief.probabilities() @ off)
    cost = np.round(KEEP * belief.cost + off + ends_off, 6)  # short as JSON
    lead, features = int(np.argmin(cost)), np.empty((len(said), FEATURES))
    row, column = cell_of(body, goals.pitch, goals.distance.shape[1], goals.distance.shape[2], x, y)
    wu, wv = (float(w) for w in goals.way[lead, row, column])
    describe(body, wu, wv, theta, blocked, features)
    weight = 0.5 * said + 0.5 / len(said)
    features -= weight @ features
    wanted = np.maximum(log_said, log_said.max() - 10.0)
    wanted -= weight @ wanted
    after = Belief(
        cost,
        KEEP * belief.normal + (1.0 - KEEP) * SURE * np.eye(FEATURES) + (features.T * weight) @ features,
        KEEP * belief.moment + (1.0 - KEEP) * SURE * STYLE + (features.T * weight) @ wanted,
        (1.0 - HABITS) * belief.habit + HABITS * said,
        (TRACK * belief.errors[0] + predicted, TRACK * belief.errors[1] + usual),
        belief.plan,
    )
    return replace(after, plan=_plan(after, t))


def _plan(belief: Belief, t: int) -> Plan:
    """The plan there is, or another where the goals have changed."""
    plan, now = belief.plan, belief.probabilities()
    if plan is not None:
        moved = now.copy()
        for goal, probability in plan.goals:
            moved[goal] -= probability
        if t < plan.since + PATIENCE or np.abs(moved).sum() <= CHANGE:
            return plan
    goals = tuple((int(g), float(now[g])) for g in np.flatnonzero(now))
    return Plan(t, goals, tuple(belief.style.tolist()))


@kernel
def _charge(
    body: Body,
    goals: Goals,
    style: Floats,
    x: float,
    y: float,
    theta: float,
    blocked: NDArray[np.bool_],
    said: Floats,
    log_said: Floats,
    end: float,
    off: Floats,
    ends_off: Floats,
) -> None:
    """The KL of the motions said from each goal's, and the log loss of the end that it predicts."""
    motions = said.shape[0]
    features, log_r = np.empty((motions, FEATURES)), np.empty(motions)
    row, column = cell_of(body, goals.pitch, goals.distance.shape[1], goals.distance.shape[2], x, y)
    for g in range(off.shape[0]):
        describe(body, goals.way[g, row, column, 0], goals.way[g, row, column, 1], theta, blocked, features)
        react(features, style, 1.0, log_r)
        off[g] = 0.0
        for m in range(motions):
            r = (1.0 - FLOOR) * math.exp(log_r[m]) + FLOOR / motions
            off[g] += said[m] * (log_said[m] - math.log(r))
        chance = 0.98 * end_chance(goals.distance[g, row, column]) + 0.005
        ends_off[g] = -(end * math.log(chance) + (1.0 - end) * math.log(1.0 - chance))
