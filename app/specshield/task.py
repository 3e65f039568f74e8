"""A task: the world, the robot and the rule that it has to keep. Immutable, named by its content's hash."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Hashable, Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property, wraps
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import ArrayLike

from specshield.arrays import Floats
from specshield.errors import InputError, MapError, SampleError
from specshield.robot import Robot, robot_to_json
from specshield.stl import BODY_WORDS, Formula, body_name, is_name, parse, region_named
from specshield.world import checks
from specshield.world.occupancy import OccupancyGrid
from specshield.world.regions import Area, Region, area_distance, region_from_json, region_to_json

POSE_NAMES = ("x", "y", "theta")
MAX_REGIONS = 256  # of one spec, and rooms of one map
MAX_HORIZON = 1000  # [steps] unless the caller sets another limit
MAX_NAME = 64  # characters
LARGEST = 1e100  # magnitude of a signal's value, so that arithmetic on it stays finite
MAX_KEPT = 64  # things of one kind that are kept with a task; its parts are seldom more than ten
SIGNAL = f"a number from {-LARGEST:g} to {LARGEST:g}"


@dataclass(frozen=True, eq=False)
class Task:
    """regions: those that the formula names, both the spec's own and the map's rooms.

    signals: the signals that the formula reads, with the value that each has before its first sample.
    """

    grid: OccupancyGrid
    robot: Robot
    formula: Formula
    regions: Mapping[str, Region]
    signals: Mapping[str, float]

    @cached_property
    def horizon(self) -> int:  # walked once: every decision asks for it several times
        return self.formula.horizon

    @cached_property
    def areas(self) -> Mapping[str, Area]:
        """What the formula reads of the regions, by the name that it reads it by: `R`, `touches(R)` or
        `inside(R)`. Plain `R` is measured at the robot's origin, as in the paper, the others at the centre of
        its round footprint.
        """
        found: dict[str, Area] = {}
        for name in self.formula.names:
            how, region = region_named(name)
            if how is None and name in self.regions:
                found[name] = Area(self.regions[name])
            elif how is not None:
                grown = self.robot.radius if how == "touches" else -self.robot.radius
                found[name] = Area(self.regions[region], grown, self.robot.offset)
        return found

    @cached_property
    def content_hash(self) -> str:
        """sha256 of everything that decides what the task means, as hex."""
        content = {
            "grid": self.grid.content_hash,
            "robot": robot_to_json(self.robot),
            "formula": str(self.formula),
            "regions": {name: region_to_json(region) for name, region in sorted(self.regions.items())},
            "signals": dict(sorted(self.signals.items())),
        }
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()

    def samples(self, poses: ArrayLike, signals: Mapping[str, Floats] | None = None) -> dict[str, Floats]:
        """What the formula reads along a trajectory, {name: [..., N]}, for `stl.robustness`.

        poses [..., N, 3] in metres and radians. signals {name: [n]} with n <= N: the last value is held to N
        (J is conditional on that), and the initial value where none was sent.
        """
        array = np.asarray(poses, dtype=np.float64)
        result: dict[str, Floats] = {}
        for name in self.formula.names:
            if name in self.areas:
                result[name] = area_distance(self.areas[name], array)
            elif name in POSE_NAMES:
                result[name] = array[..., POSE_NAMES.index(name)]
            else:
                result[name] = np.broadcast_to(self.signal(name, signals, array.shape[-2]), array.shape[:-1])
        return result

    def signal(self, name: str, signals: Mapping[str, Floats] | None, n: int) -> Floats:
        """A signal's first n samples, shape (n,). Where fewer were sent, the last value is held."""
        sent = np.asarray((signals or {}).get(name, ()), dtype=np.float64)
        held = np.full(n, sent[-1] if len(sent) else self.signals[name])
        held[: len(sent)] = sent
        return held


F = TypeVar("F", bound=Callable[..., Any])
NOT_KEPT: Any = object()


def kept_with_task(function: F) -> F:
    """Keeps what the function returns for a task in that task's __dict__, so that it goes with the task. A
    cache of the function's own would keep the maps of tasks that nobody uses any more.
    """
    name = f"{function.__module__}.{function.__qualname__}"

    @wraps(function)
    def kept(task: Task, /, *more: Hashable) -> Any:
        own: dict[Any, Any] = task.__dict__.setdefault(name, {})
        found = own.get(more, NOT_KEPT)
        if found is NOT_KEPT:
            found = function(task, *more)
            for old in list(own)[: max(len(own) + 1 - MAX_KEPT, 0)]:
                own.pop(old, None)
            own[more] = found
        return found

    return cast(F, kept)


def make_task(
    grid: OccupancyGrid,
    robot: Robot,
    formula: str,
    regions: Mapping[str, Any] | None = None,
    rooms: Mapping[str, Region] | None = None,
    signals: Mapping[str, float] | None = None,
    max_horizon: int = MAX_HORIZON,
) -> Task:
    """Checks and joins the parts of a task.

    regions: {name: region JSON or Region}, the spec's own. A region or a signal takes precedence over a room
    of the map with the same name. Raises FormulaError, MapError (regions), SampleError (signals), with the
    path of the field below the spec.
    """
    declared = parse_regions(regions or {})
    initial = parse_signals(signals or {}, declared)
    known = {name: room for name, room in (rooms or {}).items() if name not in initial} | declared
    tree = parse(formula, names=names_for(known, initial), max_horizon=max_horizon)
    named = [region_named(name)[1] for name in tree.names]
    used = {name: known[name] for name in named if name in known}
    return Task(grid, robot, tree, used, {name: initial[name] for name in tree.names if name in initial})


def names_for(regions: Iterable[str], signals: Iterable[str]) -> list[str]:
    """Every name that a formula may use where these regions and signals are declared."""
    areas = list(regions)
    bodies = [body_name(how, region) for region in areas for how in BODY_WORDS]
    return [*areas, *bodies, *POSE_NAMES, *signals]


def parse_regions(regions: Mapping[str, Any], path: str = "regions") -> dict[str, Region]:
    """Regions by name, from JSON or `Region`s. path: of the field that holds them. Raises MapError."""
    if len(checks.mapping(regions, path)) > MAX_REGIONS:
        raise MapError(f"too many {path}", path=path, got=len(regions), expected=f"at most {MAX_REGIONS}")
    result: dict[str, Region] = {}
    for name, region in regions.items():
        where = f"{path}.{name}"
        _check_name(name, where, MapError)
        result[name] = region if isinstance(region, Region) else region_from_json(region, where)
    return result


def parse_signals(signals: Mapping[str, float], taken: Mapping[str, Any]) -> dict[str, float]:
    """Signals with their initial values. Raises SampleError with the path of the field."""
    if not isinstance(signals, Mapping):
        raise SampleError("not an object", path="signals", got=str(signals)[:80], expected="numbers by name")
    for name, value in signals.items():
        where = f"signals.{name}"
        _check_name(name, where, SampleError)
        if name in taken:
            raise SampleError("a region has this name", path=where, got=name, expected="a name of its own")
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not -LARGEST <= value <= LARGEST:
            raise SampleError(
                "a signal's initial value has to be a number in range", path=where, got=value, expected=SIGNAL
            )
    return {name: float(value) for name, value in signals.items()}


def _check_name(name: str, path: str, error: type[InputError]) -> None:
    if not is_name(name) or len(name) > MAX_NAME or name in POSE_NAMES:
        valid = f"up to {MAX_NAME} letters, digits and _, no digit first; no keyword, no x, y or theta"
        raise error(f"{name!r} cannot be a name", path=path, got=name, expected=valid)
