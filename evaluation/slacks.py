"""Rivals of look-ahead: slacks that are not a fixed number of steps.

proportional   K per cent of the rule's shortest window
adaptive       between no slack and K steps, by how much of the model's mass was infeasible lately
"""

from __future__ import annotations

from dataclasses import replace

from evaluation.methods import Answer, Floats, Shielded
from specshield.episode import Shield
from specshield.shield.decision import Config
from specshield.stl import Eventually, conjuncts
from specshield.task import Task

USUAL = 25  # per cent, or steps, where nothing is said
LATELY = 10.0  # [steps] over which the infeasible mass is averaged; chosen by hand


def proportional(task: Task, config: Config) -> Config:
    """The settings with the slack as per cent of the rule's shortest window instead of steps."""
    windows = [part.b - part.a for part in conjuncts(task.formula) if isinstance(part, Eventually)]
    return replace(config, slack=round((config.slack or USUAL) / 100.0 * min(windows, default=0)))


class Adaptive(Shielded):
    """A shield whose slack follows the model: none while it goes along, and the more, the more it resists.

    A model whose own actions are feasible may still end its task before the rule has to be thought of. One
    that resists will hardly come by itself, and what is put off is farther away then. A step's slack is K
    times the mean of the infeasible masses seen, each of which weighs less by a LATELY-th a step.
    """

    def __init__(self, shield: Shield) -> None:
        super().__init__(shield)
        self._most = shield.config.slack or USUAL

    def begin(self, seed: int) -> None:
        super().begin(seed)
        self._resists = 0.5

    def act(self, history: Floats, logits: Floats | None, draw: float) -> Answer:
        config = replace(self._shield.config, slack=round(self._most * self._resists))
        self._shield = replace(self._shield, config=config)
        answer = super().act(history, logits, draw)
        if answer.feasible_mass is not None:
            self._resists += (1.0 - answer.feasible_mass - self._resists) / LATELY
        return answer
