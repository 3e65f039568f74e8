"""What the pages say of methods, models and worlds, and the caveats beside their figures."""

from __future__ import annotations

from collections.abc import Iterable

from evaluation.decoding import ALPHA, BETA
from evaluation.experiment import split

MAIN_MODELS = ("learned", "unsteered")  # of the summary
PAPER = {  # Table II: rule satisfied and main task done, in per cent of 200 runs
    "case1": {"unmodified": (0.0, 93.5), "paper": (100.0, 92.5)},
    "case2": {"unmodified": (0.0, 99.0), "paper": (100.0, 82.5)},
}
METHODS = {
    "unmodified": "the model's own draws; after its `end` the robot stands still.",
    "hcd": """our reading of SafeDec's hard constrained decoding for rules with windows: an action is out
  where the states so far and the next one leave some conjunct no chance. After the model's `end` the robot
  stands still.""",
    "hcd+": """hcd, and from the model's `end` on the certified continuation until the rule is decided; where
  none was found, the policy's best try.""",
    "rcd": f"""our reading of SafeDec's robust constrained decoding: logit + beta exp(alpha rho(next state)),
  alpha {ALPHA:g} per metre, beta {BETA:g}. These are the best of 24 pairs (alpha 0.25 to 2, beta 1 to
  10,000) by how often the rule is kept, 40 runs a case with seed 77; the script of that search is not in the
  repository. After the `end` the robot stands still.""",
    "rcd+": "rcd, with the same completion after the model's `end` as hcd+.",
    "simplex": "the model's own draw where it is feasible, else one step of the certified continuation.",
    "switching": """the model's own draws until one is not feasible, which is when the slack has run out; then
  the plan drives until it has met the next obligation. A draw that breaks a G at once is only replaced.""",
    "rule-first": """the certified continuation until the rule is decided, then the model alone; its KL is
  that of the plan's actions from what the model wanted meanwhile.""",
    "visits-first": "the certified continuation until every F of the rule is met, then ours.",
    "paper": """the paper's decision rule with **our** DQN as pi_phi, rolled out after every action. The DQNs
  learned from the reward `progress`, not from the paper's funnels: it is not the paper's policy.""",
    "ours": """reachability and the DQN together; the certified continuation of each decision is handed to the
  next; hard projection.""",
    "proportional": """ours with slack in proportion to the window: NAME@M/K is K per cent of the rule's
  shortest window.""",
    "adaptive": """ours with slack that follows the model: NAME@M/K is K steps times the mean of what
  probability the model has lately given to infeasible actions.""",
    "lookahead": """ours, and once the rule has cost 1 nat, with the feasible actions weighted by what it will
  still cost the model from there, as far as a surrogate fitted to its logits can tell.""",
}
CAREFUL = """- **NAME@M/K**: with a margin of M metres, each deadline aimed at K steps early.
  **NAME@default**: as a session is where nobody says anything: margin, slack and map are learned."""
MODELS = {
    "bot": """a scripted expert, as BabyAI's bot: it goes to the nearest room that it has not looked at, looks
  around, and once it sees its target it approaches and ends. It is sure of one action a step (8 nats).""",
    "decoyed": """a goal-seeker that goes to another place first, and stays near it for some tens of steps
  before it turns to its target.""",
    "drifter": """it goes nowhere for a long time, while its preferences for actions drift, and then seeks
  its target.""",
    "goal-seeker": """it is told the way along free space and strays from it. Look-ahead's surrogate of a
  model is nearly of this kind, so look-ahead is at its best here.""",
    "jumper": "a goal-seeker that sets out for another place at random steps, and in the end for its target.",
    "learned": """a transformer that imitates shortest paths, from egocentric senses. It was trained with
  interference: in half of its training episodes it was held or steered elsewhere for tens of steps, as a
  shield does. It had 400 rounds of training, and then 200 more.""",
    "rover": """it has no map: it picks a point in what its scanner sees, rather one that is new to it, drives
  straight there, and so on; its distribution is a Gaussian over the change of heading.""",
    "unsteered": """a network like `learned`, trained in apartments of the same kind for 400 rounds without
  interference: nothing but the expert and the network itself ever chose an action.""",
}
NOISES = {
    "none": "the world is as the shield was told",
    "gaussian": "every motion ends off by sigma 0.01 m along x and along y, and by sigma 0.5 degrees",
    "slip": "5 % of the motions do nothing",
    "short": "every motion goes nine tenths of its way",
    "rough": "every motion ends off by twice as much as under gaussian",
    "obstacle": "a box 0.3 m wide that is on no map stands on the way that was certified at the start",
    "shift": "walls and furniture stand 0.05 m from where the map has them, along x or y",
    "collider": "the footprint lies behind the robot's origin; the shield was told that it is centred",
}
INTRODUCTION = """\
Written by `specshield report`; every figure is from a campaign's `results.json`. All methods share starts,
model seeds, draws and disturbances, run by run. The main task is done when the model says `end` within 1 m of
its target before 600 steps. Shares have 95 % Clopper-Pearson intervals; means, differences and ratios have
95 % intervals of a bootstrap over runs, or over whole pairs of runs. Shares of the same runs are compared by
McNemar's exact test. Extra steps are how much later the model ended than unmodified, over the n runs in which
both did the main task. `uncertainty` is `"none"` and no map is learned, but for **@default**."""
TIMES = """\
The p50 and p99 of a decision are over all decisions of all runs, with other work on the machine."""
HOW = """\
Written by `specshield report` from what `make results` or `specshield evaluate` has kept. All methods share
starts, model seeds, draws and disturbances, run by run (seed {seeds}). The main task is done when the model
says `end` within 1 m of its target before 600 steps. In the tables of the cases the robot moves as the shield
was told, and each row has {runs} runs of each model: in how many the rule was kept, in how many the main task
was done, and the means of KL and of extra steps. KL: how far the answers were from what the model wanted, in
nats, summed over a run; 0 is untouched. Extra steps: how much later the model ended than unmodified, over the
runs in which both did the main task. `uncertainty` is `"none"` and no map is learned, but for **@default**:
these are not a session's defaults. `ours` and its variants have two policies, reachability and our DQN. In
brackets are 95 % intervals, Clopper-Pearson's of shares, a bootstrap's over runs of means."""
CAVEATS = """\
What these figures are less than they may sound:

- **learned** was trained with interference: in half of its training episodes it was held or steered
  elsewhere, as a shield does. **unsteered** has the same architecture, was never held or steered, and was
  trained for less (400 rounds, where learned had 200 more): the two differ in more than interference.
- **paper** is the paper's decision rule with our DQN, which learned from another reward than the paper's.
- Maps were drawn and regions placed so that a robot that only seeks its target breaks the rule.
- A region holds where the robot's **origin** is in it, as in the paper: the body may reach into Forbidden.
- The limit of 600 steps is generous."""
WITH_200 = """\
 With 200, over the runs of {cells}, the
  model alone did its task in {unmodified}, under `ours` in {ours}, and under
  `lookahead` in {lookahead}{shared} ([harder tasks]({page}))."""
UNDER_NOISE = """\
- Where each motion ends off by sigma 1 cm along x and y and by sigma 0.5 degrees (next table), `ours`, which
  has neither margin nor slack, loses the rule in {lost} runs. **@default** is what a session
  does where nobody says more."""
SHORT = """\
**unmodified**: the model alone. **rcd+**: our reading of the robust decoding of [SafeDec](related.md),
which raises logits by the robustness of the next state alone; after the model's `end`, the certified way.
**simplex**: the model's draw where it is feasible, else the plan's. The plan is the certified way to the
rule's last step. **rule-first**: the plan until the rule is decided, then the model. **paper**: the paper's
decision rule with our DQN. **ours**: projection onto the actions after which a way was found to keep the
whole rule. **@0/25**: no margin (0 m), each deadline aimed at 25 steps early. **lookahead**: ours; once the
rule has cost 1 nat of KL, the feasible actions are weighted by the KL and the steps that the rule is
estimated to cost from there on. The page of the cases has all methods, says exactly what each does, and how
many runs each mean is over."""
TASKS = """\
case1-200, case2-200: the task has to be done within 200 steps, in place of 600. case1-two, case2-two: two
things are to be found, one after the other. Below 8 pairs of runs no interval is told."""
NOT_THE_SAME = """\
The paper's figures are of other models, maps and simulators than these; only the shapes of the rules are the
same. The cost that the paper reports (99 to 82.5 % of main tasks in case 2) is not reproduced here, where a
run has 600 steps. With 200 steps there is a cost ([harder tasks](tasks.md))."""
WHY_NEXT_STEP = """\
Next-step methods notice a window at its last step only: when the place to visit is further away than one
step, no action is left that reaches it in time. HCD keeps a G. What RCD adds to the logits leads straight
towards a place, also where a wall is between."""
WHY_SLACK = """\
Projection lets a model put a visit off to the last step from which it can still be certified, and noise
can then take that step away: slack gives time back. A margin keeps a distance from what is forbidden, and
asks for visits that reach further into a region than its edge. Without them, `ours` keeps the rule less
often than `paper` in some of these worlds, and more often in others. The slack of 8 steps was chosen by
hand. The calibrated margin covers the surprise of one step; it promises nothing about the rule as a
whole."""


def legend(methods: Iterable[str]) -> str:
    """What the methods are, of those that were run."""
    there, with_more = {split(method)[0] for method in methods}, any("@" in method for method in methods)
    lines = [f"- **{name}**: {text}" for name, text in METHODS.items() if name in there]
    return "\n".join([*lines, *([CAREFUL] if with_more else [])])
