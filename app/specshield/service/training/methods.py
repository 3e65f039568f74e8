"""The ways to make a policy: which can be had on this machine, their options, and making one."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:  # a worker waits for jobs without the weight of the core
    from specshield.task import Task

METHODS = ("dqn", "planner", "reachability")


class Made(Protocol):
    """A policy with its two files."""

    @property
    def card(self) -> dict[str, Any]: ...

    def weights(self) -> bytes: ...


def available() -> list[str]:
    """The methods that can be carried out here: learning needs torch."""
    return [method for method in METHODS if method != "dqn" or find_spec("torch") is not None]


def complete(method: str, options: Mapping[str, Any]) -> dict[str, Any]:
    """All options of the method, as JSON, those given checked. Raises PolicyError. Needs no torch."""
    from specshield.policy.dqn import settings
    from specshield.policy.planner import policy as planner
    from specshield.policy.reachability import policy as reachability

    if method == "dqn":
        return settings.options_of(settings.read_settings(options))
    if method == "planner":
        return asdict(planner.read_settings(options))
    return asdict(reachability.read_settings(options))


def check(method: str, task: Task, options: Mapping[str, Any]) -> None:
    """Raises what `make` would for a task that the method cannot serve. Needs no torch."""
    from specshield.policy.planner import policy as planner
    from specshield.policy.reachability import policy as reachability
    from specshield.rule.progress import make_rules

    if method == "planner":
        planner.check(task, planner.read_settings(options))
        return
    if method == "reachability":
        reachability.check(task, reachability.read_settings(options))
    make_rules(task)


def make(
    method: str,
    task: Task,
    options: Mapping[str, Any],
    seed: int,
    spec: dict[str, Any],
    checkpoints: Path,
    on_progress: Callable[[float, float], None],
    should_stop: Callable[[], bool],
) -> Made:
    """The policy. on_progress: share done, seconds left. Raises what the method raises."""
    if method == "reachability":
        from specshield.policy.reachability import policy as reachability

        return reachability.synthesise(task, reachability.read_settings(options), spec)
    if method == "planner":
        from specshield.policy.planner import policy as planner

        return planner.synthesise(task, planner.read_settings(options), spec)

    from specshield.policy.dqn import settings
    from specshield.policy.dqn import train as dqn

    def report(progress: dqn.Progress) -> None:
        on_progress(progress.update / progress.updates, progress.eta_s)

    return dqn.train(task, settings.read_settings(options), seed, report, checkpoints, should_stop, spec)
