"""What a session has learned of its model: where the model goes, if anywhere, how sharply, and how far the
stand-ins can be trusted to say what it will do.

At each step every goal, and wandering, is charged the KL of what the model said from what the stand-in
(surrogate.py) would have said. The one that has been charged least is the likeliest. The model's habits, a
running average of what it said, predict it too. If they predict it far better than the stand-ins do, the
trust falls to nothing, and look-ahead has no effect.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from specshield.arrays import Bools, Floats
from specshield.compiled import kernel
from specshield.lookahead.goals import Goals, cell_of
from specshield.lookahead.lattice import Pose, blocked_at
from specshield.lookahead.surrogate import FEATURES, WANDER, bearing_of, features_of, follow
from specshield.portable import exp, inner, log, solve
from specshield.robot.dynamics import Body, displacements

# Chosen by hand; what the whole is worth is measured by `specshield evaluate` and benchmarks.told.
STYLE = np.array([2.0, 2.0, -2.0, -1.0])  # of an unknown model: the logit of each feature
SURE = 3.0  # for how many observations STYLE counts
KEEP = 0.97  # the share of the charges that is kept from one step to the next: models change their minds
TRACK = 0.95  # the same for `excess`
HABITS = 0.1  # the weight of a new observation in the running average
DOUBT = 6.0  # [nats] the excess at which the trust is 0.5; it goes back about 1 / (1 - TRACK) steps
WARY = 6.0  # [nats] the excess at first: a model that ends soon by itself is best left alone
SHARP = 20.0  # weighs the charges: a KL is of a whole distribution, which tells more than one draw from it
POSSIBLE = 0.03  # goals with a smaller share of the likeliest goal's probability are left out
FLOOR = 0.03  # the share of a stand-in's mass that is spread over all motions: nothing rules a goal out
LEAST_SAID = 1e-6  # the probability that counts for a motion that the model rules out
FLATTEST, STEEPEST = 0.5, 4.0  # the range of logits a feature that a model is believed to have


@dataclass(frozen=True)
class Belief:
    """cost [G + 1]: what each goal and, last, wandering have been charged [nats]. normal [F, F], moment [F]:
    the normal equations of the least squares that fit the model's style. habit [M]: the running average of
    the probabilities of its motions. excess: the running sum of what the likely stand-ins were charged more
    than the habit was [nats]. forced: what the rule would have cost the model so far if every answer had been
    projection's [nats].
    """

    cost: Floats
    normal: Floats
    moment: Floats
    habit: Floats
    excess: float
    forced: float

    @property
    def trust(self) -> float:
        """How far the stand-ins can be trusted, 0 to 1."""
        return 0.5 * (1.0 + math.tanh(0.5 * (DOUBT - self.excess)))

    @property
    def style(self) -> Floats:
        """The logit of each feature, shape (F,): one number for progress, turning and being blocked."""
        fitted = solve(self.normal, self.moment)
        sharp = min(max(float(fitted[:2].mean()), FLATTEST), STEEPEST)
        return np.array([sharp, sharp, -sharp, fitted[3]])

    def probabilities(self) -> Floats:
        """The probabilities that the model goes to each goal, and last that it wanders, (G + 1,)."""
        goals, wander = self.cost[:-1], self.cost[-1]
        odds = exp(SHARP * (goals.min() - goals))
        odds[odds < POSSIBLE] = 0.0
        going = 0.5 * (1.0 + math.tanh(0.5 * float(wander - goals.min())))
        return np.append(going * odds / odds.sum(), 1.0 - going)

    def to_bytes(self) -> bytes:
        parts = (self.cost, self.normal.ravel(), self.moment, self.habit, [self.excess, self.forced])
        return np.concatenate(parts).astype("<f8").tobytes()

    @staticmethod
    def from_bytes(content: bytes, motions: int) -> Belief:
        """What `to_bytes` wrote, for a robot of so many motions."""
        values = np.frombuffer(content, "<f8").copy()
        goals = len(values) - FEATURES * FEATURES - FEATURES - motions - 2
        cost, normal, moment, habit, last = np.split(
            values, np.cumsum([goals, FEATURES * FEATURES, FEATURES, motions])
        )
        return Belief(cost, normal.reshape(FEATURES, FEATURES), moment, habit, float(last[0]), float(last[1]))


def begin(goals: int, motions: int) -> Belief:
    """Before the first observation."""
    habit = np.full(motions, 1.0 / motions)
    return Belief(np.zeros(goals + 1), SURE * np.eye(FEATURES), SURE * STYLE, habit, WARY, 0.0)


def update(belief: Belief, goals: Goals, pose: Floats, said: Floats, end: float, forced: float) -> Belief:
    """The belief after what the model said at x_t (3,).

    said [M]: the motions' probabilities, given that the model does not end; end: the probability that it
    does. forced: the KL of projection's answer [nats].
    """
    said = np.maximum(said, LEAST_SAID) / np.maximum(said, LEAST_SAID).sum()
    log_said = log(said)
    x, y, theta = (float(v) for v in pose)
    body, blocked = goals.body, blocked_at(goals.body, x, y, theta)
    charges = _charge(goals, belief.style, (x, y, theta), blocked, said, log_said, end)
    usual = float(inner(said, log_said - log((1.0 - FLOOR) * belief.habit + FLOOR / len(said))))
    sided = _sided(body, said)  # a stand-in that wanders does not say to which side the model turns
    excess = TRACK * belief.excess + float(inner(belief.probabilities(), charges)) - usual
    excess -= float(belief.probabilities()[-1]) * sided
    cost = np.round(KEEP * belief.cost + charges, 6)  # as recorded decisions have it
    row, column = cell_of(goals, x, y)
    bearing = bearing_of(goals, int(np.argmin(cost[:-1])), row, column, theta)
    features = np.array([features_of(body, bearing, m, blocked[m]) for m in range(len(said))])
    weight = 0.5 * said + 0.5 / len(said)
    features -= inner(features.T, weight)
    wanted = np.maximum(log_said, log_said.max() - 10.0)
    wanted -= inner(weight, wanted)
    weighed = features.T * weight
    return Belief(
        cost,
        KEEP * belief.normal + (1.0 - KEEP) * SURE * np.eye(FEATURES) + inner(weighed[:, None], features.T),
        KEEP * belief.moment + (1.0 - KEEP) * SURE * STYLE + inner(weighed, wanted),
        (1.0 - HABITS) * belief.habit + HABITS * said,
        excess,
        belief.forced + forced,
    )


def _sided(body: Body, said: Floats) -> float:
    """The KL of what was said from the same with left and right made alike [nats]."""
    moves, turns = displacements(body)
    mirrored = (moves[:, None] == moves) & (np.abs(turns[:, None] + turns) < 1e-9)
    even = np.where(mirrored.any(axis=0), 0.5 * (said + inner(mirrored, said)), said)
    return float(inner(said, log(said / even)))


@kernel
def _charge(
    goals: Goals, style: Floats, pose: Pose, blocked: Bools, said: Floats, log_said: Floats, end: float
) -> Floats:
    """What each goal and wandering are charged, [G + 1]: the KL of the motions said from the stand-in's, and
    the log loss of the chance to end.
    """
    motions, wander = said.shape[0], goals.distance.shape[0]
    charges, log_r = np.empty(wander + 1), np.empty(motions)
    for g in range(charges.shape[0]):
        ends = follow(goals, g if g < wander else WANDER, style, pose, blocked, log_r)
        chance = 0.98 * ends + 0.005
        charges[g] = -(end * math.log(chance) + (1.0 - end) * math.log(1.0 - chance))
        for m in range(motions):
            r = (1.0 - FLOOR) * math.exp(log_r[m]) + FLOOR / motions
            charges[g] += said[m] * (log_said[m] - math.log(r))
    return charges
