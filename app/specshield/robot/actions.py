"""Action sets: what a robot can do in one step, and the shape it does it with."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from specshield.arrays import Bools, Ints
from specshield.errors import RobotError
from specshield.world.checks import shown

# A witness is stored as one byte a motion: the uint8 in caution/judgement.py and shield/feasibility.py holds
# no motion above 255. More actions than this would need wider witnesses there.
MAX_ACTIONS = 256
MAX_TRANSLATE = 10.0  # [m] a step


@dataclass(frozen=True)
class Action:
    """One action: move `translate` [m] along the heading, then turn `rotate` [rad] counter-clockwise.

    A `terminal` action ends the main task: it moves nothing and consumes no step.
    """

    name: str
    translate: float = 0.0
    rotate: float = 0.0
    terminal: bool = False


@dataclass(frozen=True)
class Robot:
    """A unicycle with a circular footprint.

    radius: of the footprint [m]. offset: its centre in the robot's frame, x ahead, y to the left [m].
    on_contact: `stay` (a move that would touch leaves the pose as it was) or `stop` (it stops at contact).
    """

    name: str
    radius: float
    offset: tuple[float, float]
    on_contact: str
    actions: tuple[Action, ...]

    @property
    def action_names(self) -> tuple[str, ...]:
        return tuple(action.name for action in self.actions)

    @cached_property
    def terminal(self) -> Bools:
        """Shape (A,)."""
        return np.array([action.terminal for action in self.actions])

    @cached_property
    def motions(self) -> tuple[tuple[float, float], ...]:
        """The distinct (translate, rotate) pairs of the non-terminal actions, in order of first use."""
        return tuple(dict.fromkeys((a.translate, a.rotate) for a in self.actions if not a.terminal))

    @cached_property
    def motion_of(self) -> Ints:
        """Index into `motions` of each action, -1 for a terminal one. Shape (A,)."""
        index = {motion: i for i, motion in enumerate(self.motions)}
        return np.array([-1 if a.terminal else index[a.translate, a.rotate] for a in self.actions])

    @cached_property
    def wait_motion(self) -> int:
        """The motion that leaves the pose as it is, -1 where the robot cannot stand still."""
        return self.motions.index((0.0, 0.0)) if (0.0, 0.0) in self.motions else -1

    @cached_property
    def goes_back(self) -> bool:
        """Whether some motion leads the robot backwards."""
        return any(translate < 0.0 for translate, _ in self.motions)

    @cached_property
    def representative(self) -> Ints:
        """The lowest action index of each motion. Shape (M,)."""
        return np.array([int(np.argmax(self.motion_of == i)) for i in range(len(self.motions))])

    @cached_property
    def action_table(self) -> bytes:
        """`representative` as `bytes.translate` takes it, for motions of one byte each."""
        return bytes(self.representative.tolist()).ljust(256, b"\0")


def _stretch() -> Robot:
    turn, nudge = math.radians(30), math.radians(6)
    translate = {"m": 0.2, "b": -0.2}
    rotate = {"r": -turn, "l": turn, "rs": -nudge, "ls": nudge}
    tokens = "m r l b end sub_done ls rs p zm zp yp ym wp wm yms zms zps yps d"
    actions = tuple(
        Action(name, translate.get(name, 0.0), rotate.get(name, 0.0), name == "end")
        for name in tokens.split()
    )
    return Robot("stretch", radius=0.1855, offset=(-0.109, 0.0), on_contact="stop", actions=actions)


STRETCH = _stretch()
"""The 20 tokens of SPOC, PoliFormer and FLaRe on a Hello Robot Stretch (docs/architecture.md)."""

PRESETS = {"stretch": STRETCH}


def robot_from_json(spec: Any) -> Robot:
    """A preset's name, or {"footprint": {"radius", "offset"}, "on_contact", "actions": [...]}.

    Raises RobotError with the path of the field at fault.
    """
    if isinstance(spec, str):
        if spec not in PRESETS:
            known = f"one of {', '.join(sorted(PRESETS))}; or an object with footprint and actions"
            raise _wrong(f"unknown robot {spec!r}", None, spec, known)
        return PRESETS[spec]
    _keys(spec, "", {"footprint", "actions"}, {"on_contact"})
    footprint = spec["footprint"]
    _keys(footprint, "footprint", {"radius"}, {"offset"})
    radius = _number(footprint["radius"], "footprint.radius", low=1e-3, high=5.0)
    offset = footprint.get("offset", [0.0, 0.0])
    if not isinstance(offset, (list, tuple)) or len(offset) != 2:
        raise _wrong("an offset is two numbers", "footprint.offset", offset, "[x, y] in metres")
    ox, oy = (_number(v, f"footprint.offset[{i}]", low=-5.0, high=5.0) for i, v in enumerate(offset))
    on_contact = spec.get("on_contact", "stay")
    if on_contact not in ("stay", "stop"):
        raise _wrong("unknown contact rule", "on_contact", on_contact, "'stay' or 'stop'")
    items = spec["actions"]
    if not isinstance(items, list) or not 1 <= len(items) <= MAX_ACTIONS:
        raise _wrong("a robot has a list of actions", "actions", shown(items), f"1 to {MAX_ACTIONS} actions")
    actions = tuple(_action(item, f"actions[{i}]") for i, item in enumerate(items))
    names = [action.name for action in actions]
    for i, name in enumerate(names):
        if name in names[:i]:
            raise _wrong("two actions have one name", f"actions[{i}].name", name, "unique names")
    if all(action.terminal for action in actions):
        raise _wrong("every action is terminal", "actions", names, "at least one that is not")
    return Robot("custom", radius, (ox, oy), on_contact, actions)


def robot_to_json(robot: Robot) -> str | dict[str, Any]:
    """What `robot_from_json` reads back to an equal robot."""
    if PRESETS.get(robot.name) == robot:
        return robot.name
    actions: list[dict[str, Any]] = [
        {"name": a.name, "terminal": True}
        if a.terminal
        else {"name": a.name, "translate": a.translate, "rotate": a.rotate}
        for a in robot.actions
    ]
    footprint = {"radius": robot.radius, "offset": list(robot.offset)}
    return {"footprint": footprint, "on_contact": robot.on_contact, "actions": actions}


def _action(item: Any, path: str) -> Action:
    _keys(item, path, {"name"}, {"translate", "rotate", "terminal"})
    name = item["name"]
    if not isinstance(name, str) or not 1 <= len(name) <= 64:
        raise _wrong("an action needs a name", f"{path}.name", name, "1 to 64 characters")
    terminal = item.get("terminal", False)
    if not isinstance(terminal, bool):
        raise _wrong("terminal is true or false", f"{path}.terminal", terminal, "true or false")
    most, turn = MAX_TRANSLATE, 2 * math.pi
    translate = _number(item.get("translate", 0.0), f"{path}.translate", -most, most)
    wide = "a number of radians, at most a whole turn, 2 pi, either way; 30 degrees are 0.5236"
    rotate = _number(item.get("rotate", 0.0), f"{path}.rotate", -turn, turn, wide)
    if terminal and (translate or rotate):
        raise _wrong("a terminal action moves nothing", path, item, "no translate, no rotate")
    return Action(name, translate, rotate, terminal)


def _keys(item: Any, path: str, required: set[str], optional: set[str]) -> None:
    which = path or "the robot"
    if not isinstance(item, dict):
        told, expected = f"{which} is not an object", f"an object with {sorted(required)}"
        raise _wrong(told, path or None, shown(item), expected)
    missing, unknown = required - item.keys(), item.keys() - required - optional
    if missing or unknown:
        said = f"lacks {sorted(missing)}" if missing else f"has unknown fields {sorted(map(str, unknown))}"
        expected = f"{sorted(required)}, and {sorted(optional)} if need be"
        raise _wrong(f"{which} {said}", path or None, sorted(map(str, item)), expected)


def _number(value: Any, path: str, low: float, high: float, expected: str | None = None) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not low <= value <= high:
        expected = expected or f"a number from {low:g} to {high:g} metres"
        raise _wrong("not a number in range", path, value, expected)
    return float(value)


def _wrong(told: str, path: str | None, got: Any, expected: str) -> RobotError:
    return RobotError(told, path=path, got=got, expected=expected)
