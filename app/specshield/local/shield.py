"""A shield in this process, prepared once for many sessions."""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from specshield.caution.signals import any_signal
from specshield.client.models import SessionInfo
from specshield.client.wire import pose_values
from specshield.errors import InputError, MapError, NotFound, PolicyError
from specshield.local.rule import Rule, told
from specshield.local.session import LocalSession
from specshield.local.settings import plain, read_settings
from specshield.lookahead.preferences import PROJECTION, prepare
from specshield.map_files import read_map_files
from specshield.policy.methods import DEFAULT, METHODS, Run, load_policy
from specshield.policy.notices import notices
from specshield.policy.options import read_options
from specshield.reasons import refusal
from specshield.robot import Robot, robot_from_json
from specshield.shield.decision import Config, Shield, check_preferring, make_shield
from specshield.shipped import MAPS, MODELS
from specshield.task import Task, make_task, parse_regions
from specshield.world.formats import read_map
from specshield.world.map_server import dump_map
from specshield.world.occupancy import OccupancyGrid
from specshield.world.regions import Region

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from specshield.client.models import Beginning

log = logging.getLogger("specshield")
World = OccupancyGrid | Path | str | Mapping[str, Any]


@dataclass(frozen=True, eq=False, repr=False)  # in full it has millions of letters
class LocalShield:
    """A task and the policy that proposes futures for it. `session` begins an episode. card, weights: the
    policy's files, as `save` writes them.
    """

    shield: Shield
    card: Mapping[str, Any]
    weights: bytes

    @property
    def task(self) -> Task:
        return self.shield.task

    @staticmethod
    def shipped(name: str) -> LocalShield:
        """The policy of this name that came with specshield, such as `case1`. Raises NotFound."""
        names = sorted(card.parent.name for card in MODELS.glob("*/card.json"))
        if name not in names:
            expected = f"one of {', '.join(names)}"
            raise NotFound("no such policy came with specshield", path="name", got=name, expected=expected)
        folder = MODELS / name
        wanted = json.loads((folder / "card.json").read_text())["map_id"]
        for path in sorted(MAPS.glob("*.yaml")):
            if wanted in (path.stem, _read_world(path)[0].content_hash):
                return LocalShield.load(folder, path)
        raise NotFound(f"the map of {name} is not in {MAPS}", path="map", got=wanted)

    @staticmethod
    def load(folder: str | Path, world: World | None = None) -> LocalShield:
        """Read a policy from a folder with `card.json`, `policy.safetensors` and, unless `world` is given,
        its map: the only `.yaml` there, with its image beside it. Raises PolicyError, MapError.
        """
        folder = Path(folder)
        try:
            card = json.loads((folder / "card.json").read_text())
            robot, spec, formula, _ = card["robot"], card["spec"], card["spec"]["formula"], card["id"]
            weights = (folder / "policy.safetensors").read_bytes()
        except (OSError, ValueError, KeyError, TypeError) as error:
            expected = "a folder with card.json, which has an id, a robot and a spec, and policy.safetensors"
            wrong = f"no policy can be read there: {error}"
            raise PolicyError(wrong, path="folder", got=str(folder), expected=expected) from None
        if world is None:
            found = sorted(folder.glob("*.yaml"))
            if len(found) != 1:
                wrong = "the folder does not say which map the policy is for"
                got, expected = [each.name for each in found], f"one .yaml in {folder}, or a `world`"
                raise MapError(wrong, path="world", got=got, expected=expected)
            world = found[0]
        grid, rooms = _read_world(world)
        named = spec.get("regions"), rooms, spec.get("signals")
        task = make_task(grid, robot_from_json(robot), formula, *named)
        return LocalShield(make_shield([load_policy(weights, card, task)]), card, weights)

    @staticmethod
    def make(
        world: World,
        formula: str,
        regions: Mapping[str, Any] | None = None,
        *,
        rooms: Mapping[str, Any] | None = None,
        signals: Mapping[str, float] | None = None,
        robot: Robot | str | Mapping[str, Any] = "stretch",
        method: str = DEFAULT,
        options: Mapping[str, Any] | None = None,
        seed: int = 0,
        check: bool = True,
    ) -> LocalShield:
        """Make a policy, by reachability in about a second.

        world: a grid, the path of a map's `.yaml`, or a map as the API takes it in JSON, with its `format`.
        rooms: named areas beside the map's own, in the form of `regions`. check: whether to try some random
        starts, and to warn if they show problems. The other arguments are those of the SDK's
        `policies.create`.
        """
        grid, own = _read_world(world)
        regions, rooms, robot, signals, options = map(plain, (regions, rooms, robot, signals, options))
        made_robot = robot if isinstance(robot, Robot) else robot_from_json(robot)
        named = {**own, **parse_regions(rooms or {}, "rooms")}
        task = make_task(grid, made_robot, formula, regions, named, signals)
        seed = read_settings({"seed": seed})["seed"]
        how = METHODS.get(method)
        settings = read_options(how.options, options or {})
        how.check(task, settings)
        made = how.make(task, settings, Run(seed))
        weights = made.weights()
        policy = load_policy(weights, made.card, task)
        card = {**made.card, "warnings": list(notices(policy)) if check else []}
        for notice in card["warnings"]:
            log.warning("%s", notice)
        return LocalShield(make_shield([policy]), card, weights)

    def save(self, folder: str | Path) -> None:
        """Write the files that `load` reads. A server takes them too, in a folder of its `models_dir`.

        Raises InputError if they cannot be written.
        """
        folder = Path(folder)
        text, image = dump_map(self.task.grid)
        try:
            folder.mkdir(parents=True, exist_ok=True)
            (folder / "map.yaml").write_text(text)
            (folder / "map.pgm").write_bytes(image)
            (folder / "policy.safetensors").write_bytes(self.weights)
            (folder / "card.json").write_text(json.dumps(dict(self.card), indent=1))
        except OSError as error:
            told = f"the policy cannot be written there: {error.strerror}"
            raise InputError(told, path="folder", got=str(folder), expected="a folder to write to") from error

    def session(self, **options: Unpack[Beginning]) -> LocalSession:
        """Begin at `initial_pose`; the options are those of the SDK's `sessions.create`, without policies.

        Raises PoseError, InfeasibleStart (unless `allow_infeasible`), and InputError for a wrong setting.
        """
        given: dict[str, Any] = {**options}
        pose = pose_values(given.pop("initial_pose", None), "initial_pose")
        settings = read_settings(given)
        id, allowed = settings.pop("id", None) or "local", settings.pop("allow_infeasible", False)
        shaping = settings.pop("shaping", PROJECTION)
        config = Config(**settings)
        if shaping != PROJECTION:
            check_preferring(config)
        shield = self.configured(config, shaping)
        feasible, way = refusal.begin(shield, pose, allowed)
        signals = shield.task.signals
        rows = np.array([[*pose, *signals.values()]])
        rules = told([Rule(self, shield)], rows, [*signals])
        info = SessionInfo(
            id=id,
            **self.about(),
            next_t=0,
            feasible=feasible,
            spec_status=rules[0]["spec_status"],
            main_task_done=False,
            finished=False,
            expires_at="",
            margin=shield.config.margin,
            rules=rules,
            any_signal=any_signal(shield, rows[:, :3]),
        )
        return LocalSession(self, shield, shaping, info, rows, way)

    def configured(self, config: Config, shaping: str) -> Shield:
        """The shield with a session's settings."""
        shield = replace(self.shield, config=config)
        return shield if shaping == PROJECTION else replace(shield, preference=self._preference(shaping))

    def about(self) -> dict[str, Any]:
        """The fields of a session's info that come from the policy and its task."""
        task = self.task
        return {
            "policy_ids": (str(self.card["id"]),),
            "map_id": task.grid.content_hash,
            "spec": {"formula": str(task.formula), "regions": self.card["spec"].get("regions", {})},
            "horizon": task.horizon,
            "actions": task.robot.action_names,
            "terminal_actions": tuple(np.flatnonzero(task.robot.terminal).tolist()),
        }

    @cache  # noqa: B019  a preference takes seconds to prepare, and shields are few
    def _preference(self, name: str) -> Any:
        grid = self.task.grid
        row, column = np.unravel_index(int(np.argmax(grid.clearance)), grid.clearance.shape)
        return prepare(name, self.task, self.shield.proposers, [*grid.centres[row, column], 0.0])


def _read_world(world: object) -> tuple[OccupancyGrid, Mapping[str, Region]]:
    """A map and its named areas. Raises MapError for what is no `World`."""
    if isinstance(world, OccupancyGrid):
        return world, {}
    if isinstance(world, Mapping):
        members = plain(world)
        return read_map(members.pop("format", None), members)
    if not isinstance(world, str | os.PathLike):
        expected = "an OccupancyGrid, the path of a map's YAML, or a map as the API takes it"
        raise MapError("this is no world", path="world", got=f"a {type(world).__name__}", expected=expected)
    return read_map_files(Path(world))
