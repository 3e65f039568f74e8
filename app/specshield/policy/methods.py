"""The ways to make a policy, by name.

To add one: a file that defines a `Method`, and a line below (or an entry point of the group
`specshield.methods` in a package of its own).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from specshield.errors import InputError, PolicyError
from specshield.registry import Registry

if TYPE_CHECKING:  # a worker waits for jobs without the weight of the core
    from specshield.policy.card import Card
    from specshield.shield.proposal import Proposer
    from specshield.task import Task

DEFAULT = "reachability"


class Made(Protocol):
    """A policy with its two files."""

    @property
    def card(self) -> Card: ...

    def weights(self) -> bytes: ...


@dataclass(frozen=True)
class Run:
    """What the making of one policy is given beside its task and options.

    spec: the rule as it was asked for, for the card. checkpoints: a folder to save to, and to go on from.
    on_progress: told the share that is done, the seconds that are left, and what there is to say of it.
    """

    seed: int = 0
    spec: dict[str, Any] | None = None
    checkpoints: Path | None = None
    on_progress: Callable[[float, float, str], None] = lambda done, seconds_left, said: None


@dataclass(frozen=True)
class Method:
    """A way to make a policy for a task.

    about: one sentence. options: a frozen dataclass of `option` fields (policy/options.py). needs: modules
    that have to be installed where policies are made; those that only serve need none of them.

    check(task, options) raises what `make` would for a task that the method cannot serve, and makes nothing.
    make(task, options, run) makes the policy; it may take hours, in a process of its own.
    load(weights, card, task) reads one back, from the bytes or the path of its weights, and raises
    PolicyError where they do not fit the task.

    Whatever is slow to import is imported inside of these.
    """

    about: str
    options: type[Any]
    check: Callable[[Task, Any], None]
    make: Callable[[Task, Any, Run], Made]
    load: Callable[[bytes | Path, Card, Task], Proposer]
    needs: tuple[str, ...] = ()


def lazily(place: str) -> Callable[..., Any]:
    """The function at "module:name", imported when it is called."""

    def call(*arguments: Any) -> Any:
        module, _, name = place.partition(":")
        return getattr(import_module(module), name)(*arguments)

    return call


METHODS = Registry(
    "method",
    Method,
    "specshield.methods",
    {
        "dqn": "specshield.policy.dqn.method:METHOD",
        "planner": "specshield.policy.planner.method:METHOD",
        "reachability": "specshield.policy.reachability.method:METHOD",
    },
)


def available() -> list[str]:
    """The names of the methods that this machine has all modules for."""
    return [name for name, method in METHODS.usable() if not missing(method)]


def missing(method: Method) -> list[str]:
    """The modules that making a policy by this method needs and that are not installed here."""
    return [module for module in method.needs if find_spec(module) is None]


def load_policy(weights: bytes | Path, card: Card, task: Task) -> Proposer:
    """A policy from its two files, for the task it was made for. Raises PolicyError where they do not fit."""
    if card.get("task_hash") != task.content_hash:
        told, expected = "the policy was made for another task", task.content_hash
        raise PolicyError(told, path="card.task_hash", got=card.get("task_hash"), expected=expected)
    try:
        method = METHODS.get(str(card.get("method")))
    except InputError as error:
        raise PolicyError(
            error.message, path="card.method", got=error.got, expected=error.expected
        ) from error
    return method.load(weights, card, task)
