"""An experiment: a case, a model, a disturbance and a seed; its setting: what each process prepares once."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from functools import cached_property, lru_cache
from typing import Any

from evaluation.baselines import Completed, RuleFirst, Switching, VisitsFirst
from evaluation.decoding import HardDecoding, RobustDecoding
from evaluation.disturbance import MOVED, believed, check
from evaluation.houses import load_house_case
from evaluation.methods import Decoding, Method, Shielded, Simplex
from evaluation.models import named
from evaluation.shipped import shipped
from evaluation.slacks import Adaptive, proportional
from evaluation.tasks import MainTask, main_task
from specshield import __version__
from specshield.episode import Shield, make_shield
from specshield.errors import InputError, NotFound
from specshield.lookahead.lookahead import prepare
from specshield.policy.dqn.policy import Policy
from specshield.policy.reachability.policy import ReachabilityPolicy, synthesise
from specshield.robot.dynamics import Body, make_body
from specshield.shield.decision import Config, ThresholdOver
from specshield.shield.uncertainty import Uncertainty
from specshield.shipped import MODELS
from specshield.sim.cases import Case, case_name, case_names, load_case
from specshield.sim.learned.model import WEIGHTS, read
from specshield.sim.model import FoundationModel
from specshield.task import Task

METHODS = (
    "unmodified", "hcd", "hcd+", "rcd", "rcd+", "simplex", "switching", "rule-first", "visits-first", "paper",
    "ours", "proportional", "adaptive", "lookahead",
)  # fmt: skip
CERTIFYING = METHODS[METHODS.index("simplex") :]
SLACKS = ("proportional", "adaptive")  # what K says of their slack is not steps (slacks.py)
CAREFUL = CERTIFYING  # NAME@M/K: a margin of M metres, K steps of slack


SESSIONS = {  # NAME@default: what a session is where nobody says anything
    "default": Config(uncertainty=Uncertainty(), learn_map=True),
    "episode": Config(),
    "step": Config(),
    "robustness": Config(evaluation="robustness"),  # J = rho
}
FORMS = (
    "NAME@METRES, NAME@METRES/STEPS, NAME@conformal/STEPS, NAME@default, NAME@default/SHARE, "
    f"NAME@episode/SHARE, NAME@step/SHARE or NAME@robustness/METRES, with NAME one of {', '.join(CAREFUL)}"
)
THRESHOLDS: dict[str, ThresholdOver] = {  # NAME@default/D and so on: over what the threshold D holds
    "default": "episode", "episode": "episode", "step": "step", "robustness": "step"
}  # fmt: skip


@dataclass(frozen=True)
class Experiment:
    """One campaign's conditions; with the number of a run they decide everything that is random in it.

    case: a name of sim/cases.py, or "house", with a suffix of tasks.py for a harder main task. house: then
    which one, as evaluation/houses.py takes it.
    model: a name of evaluation/models/. noise: a name of evaluation/disturbance.py.
    """

    case: str
    house: str | None = None
    model: str = "learned"
    noise: str = "none"
    seed: int = 0

    def __post_init__(self) -> None:
        check(self.noise)
        named(self.model)
        if self.main.two and self.noise in MOVED:
            raise InputError(
                "two things can be looked for in a world as told alone", path="noise", got=self.noise,
                expected=f"none of {', '.join(MOVED)}",
            )  # fmt: skip
        if (self.main.base == "house") != (self.house is not None):
            raise InputError(
                "the case 'house' needs a house, and the other cases take none", path="house", got=self.house,
                expected="--house drawn_0 with --case house, and no --house with any other case",
            )  # fmt: skip

    def to_json(self) -> dict[str, Any]:
        return asdict(self)

    @staticmethod
    def from_json(value: Mapping[str, Any]) -> Experiment:
        return Experiment(**value)

    @property
    def main(self) -> MainTask:
        return main_task(self.case)

    @property
    def setting(self) -> Setting:
        return _setting(self)


@dataclass(frozen=True, eq=False)
class Setting:
    """What an experiment needs; each part is prepared when it is first asked for.

    case: as the experiment names it; plain: without its suffix. task, body: what the shield is told, which a
    disturbance may make wrong.
    """

    experiment: Experiment
    case: Case
    plain: Case
    task: Task
    body: Body

    @cached_property
    def model(self) -> FoundationModel:
        return self.experiment.main.model(named(self.experiment.model).make, self.plain)

    @cached_property
    def learned(self) -> Policy | None:
        """The DQN that was trained for the case; None where there is none."""
        try:
            policy = shipped(self.plain, "dqn")
        except NotFound:
            return None
        return replace(policy, task=self.task) if isinstance(policy, Policy) else None

    @cached_property
    def policies(self) -> tuple[ReachabilityPolicy | Policy, ...]:
        """Reachability, then the DQN if there is one."""
        computed = synthesise(self.task)
        return (computed,) if self.learned is None else (computed, self.learned)

    @cached_property
    def paper(self) -> Shield:
        """The paper's shield. Raises NotFound where there is no DQN for the case."""
        if self.learned is None:
            raise NotFound(
                f"there is no learned policy for {self.case.name}", path="methods", got="paper",
                expected="a case with a folder in models/, or other methods",
            )  # fmt: skip
        return make_shield([replace(self.learned, literal=True)])

    @cached_property
    def ours(self) -> Shield:
        return make_shield(self.policies)

    @cached_property
    def made_from(self) -> dict[str, Any]:
        """What the records depend on besides the experiment's own fields, as JSON; files by their sha256."""
        case = self.case
        made_from = {
            "specshield": __version__,
            "task": case.task.content_hash,
            "instruction": case.instruction,
            "target": list(case.target),
            "code of the model": named(self.experiment.model).code_hash,
        }
        for policy in self.policies:
            made_from[f"policy {policy.card['method']}"] = _hash(policy.weights())
        folder = named(self.experiment.model).folder
        if folder is not None:
            temperature = read(MODELS / folder).temperature
            made_from["learned model"] = _hash((MODELS / folder / WEIGHTS).read_bytes() + b"%r" % temperature)
        return made_from

    def method(self, name: str) -> Method:
        """A method by its name; NAME@M/K is one with a margin of M metres and K steps of slack, NAME@default
        one as a session is where nobody says anything: it learns its robot and its map. A threshold D is
        NAME@step/D at each step, NAME@episode/D over the episode, NAME@robustness/D in metres with J = rho.

        Raises NotFound for a name that there is not, InputError for a margin that cannot be.
        """
        kind, careful = split(name)
        make: dict[str, Callable[[], Method]] = {
            "unmodified": lambda: Decoding(self.task),
            "hcd": lambda: Decoding(self.task, HardDecoding(self.task)),
            "hcd+": lambda: Completed(Decoding(self.task, HardDecoding(self.task)), self.ours),
            "rcd": lambda: Decoding(self.task, RobustDecoding(self.task)),
            "rcd+": lambda: Completed(Decoding(self.task, RobustDecoding(self.task)), self.ours),
            "simplex": lambda: Simplex(make_shield(self.policies, careful)),
            "switching": lambda: Switching(make_shield(self.policies, careful)),
            "rule-first": lambda: RuleFirst(make_shield(self.policies, careful)),
            "visits-first": lambda: VisitsFirst(make_shield(self.policies, careful)),
            "paper": lambda: Shielded(replace(self.paper, config=careful), carries=False),
            "ours": lambda: Shielded(make_shield(self.policies, careful)),
            "proportional": lambda: Shielded(make_shield(self.policies, proportional(self.task, careful))),
            "adaptive": lambda: Adaptive(make_shield(self.policies, careful)),
            "lookahead": lambda: Shielded(
                make_shield(self.policies, careful, prepare(self.task, self.policies))
            ),
        }
        return make[kind]()


def experiments(case: str, house: str | None, model: str, noise: str, seed: int) -> list[Experiment]:
    """One experiment for each of the names that `noise` holds, separated by commas.

    case: a case's name, or its number.
    """
    return [Experiment(case_name(case), house, model, each, seed) for each in noise.split(",")]


def available(case: str) -> list[str]:
    """The methods that a case has what they need for: `paper` needs a DQN, which case1 and case2 have."""
    learned = main_task(case_name(case)).base in case_names()
    return [name for name in METHODS if name != "paper" or learned]


def certifies(method: str) -> bool:
    """Whether a method gives mass to certified actions alone: a threshold below 1, or in metres, does not."""
    kind, session = split(method)
    return kind in CERTIFYING and session.evaluation == "feasibility" and session.threshold == 1.0


def split(method: str) -> tuple[str, Config]:
    """The kind of a method, and its session's settings. Raises NotFound or InputError."""
    kind, at, asked = method.partition("@")
    if kind not in METHODS:
        told = f"there is no method {kind!r}"
        raise NotFound(told, path="methods", got=method, expected=f"{', '.join(METHODS)}; or {FORMS}")
    if not at:
        return kind, Config()
    metres, _, steps = asked.partition("/")
    try:
        if metres in SESSIONS and kind in CAREFUL:
            session = SESSIONS[metres]
            if steps:
                session = replace(session, threshold=float(steps), threshold_over=THRESHOLDS[metres])
            return kind, session
        margin, slack = float(metres), int(steps or 0)
    except ValueError:
        margin, slack = math.nan, 0
    if kind not in CAREFUL or not math.isfinite(margin):
        raise InputError(
            "after the @ there is no setting of this method", path="methods", got=method, expected=FORMS
        )
    return kind, Config(margin=margin, slack=slack)


def _hash(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


@lru_cache(maxsize=4)
def _setting(experiment: Experiment) -> Setting:
    main = experiment.main
    plain = load_case(main.base) if experiment.house is None else load_house_case(experiment.house)
    task = believed(experiment.noise, plain.task)
    case = main.of(plain, experiment.case.removeprefix(main.base))
    return Setting(experiment, case, plain, task, make_body(task.robot, task.grid))
