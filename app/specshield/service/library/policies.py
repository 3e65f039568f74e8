"""The policies of a server: those in `models/`, which have names, and those in `<data>/policies/<id>/`.

Such a folder has `policy.json` (the policy's description) and, once it is made, `policy.safetensors` and then
`card.json`.
"""

from __future__ import annotations

import hashlib
import json
import logging
import shutil
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import msgspec

from specshield.errors import FormulaError, InputError, NotFound, PolicyError, SpecshieldError
from specshield.policy.card import policy_id
from specshield.policy.methods import METHODS, load_policy
from specshield.policy.options import read_options
from specshield.robot import robot_from_json
from specshield.service.access.keys import Key
from specshield.service.library import files
from specshield.service.library.claims import Claimed, missing
from specshield.service.library.maps import Maps
from specshield.service.settings import Settings
from specshield.shield.proposal import Proposer
from specshield.task import Task, make_task

KEPT_IN_MEMORY = 64
AT_ONCE = 16  # policies that are read at the same time for a list
SMALL = "policy.json", "card.json"  # the files of a policy that a list needs
WEIGHTS = "policy.safetensors"
log = logging.getLogger("specshield")


@dataclass(frozen=True)
class Description:
    """The task of a policy, and how the policy is made. All of it is JSON."""

    map_id: str
    robot: str | dict[str, Any]
    spec: dict[str, Any]
    method: str
    seed: int
    options: dict[str, Any]


@dataclass(frozen=True)
class Record:
    """A policy of this server. card: None until the policy is made."""

    id: str
    about: Description
    horizon: int
    name: str | None = None
    created_at: str | None = None
    card: dict[str, Any] | None = None


class Policies(Claimed):
    """All calls but `still_there` block: they read and write files."""

    def __init__(self, settings: Settings, maps: Maps) -> None:
        super().__init__("policies", maps.given, settings)
        self._maps = maps
        self._recent = files.Recent[Proposer](KEPT_IN_MEMORY)
        self._named: Mapping[str, Record] = {str(record.name): record for record in self._shipped()}
        self._given = {found.id: found for found in reversed(self._named.values())} | {**self._named}

    def record(self, key: str) -> Record:
        """A policy by its id, whoever owns it, or one that came with the server. Raises NotFound."""
        found = self.made_here(key)
        if found is None:
            raise missing("policies", key)
        return found

    def made_here(self, key: str) -> Record | None:
        """The policy of this id, or of this name if it came with the server; None if there is none."""
        if key in self._given:
            return self._given[key]
        stored = self._kept.find(key, "policy.json") if files.HASH.fullmatch(key) else None
        if stored is None:
            return None
        return replace(msgspec.convert(stored, Record), card=self._kept.find(key, "card.json"))

    def find(self, key: str, owner: str) -> Record:
        """A policy that this owner may use, by its id or its name. Raises NotFound."""
        found = self.record(key if key in self._named else self._id_of(key, owner))
        if found.name is None and not self.claims.holds("policies", found.id, owner):
            raise missing("policies", key)
        return found

    async def still_there(self, ids: Sequence[str], owner: str) -> None:
        """Raises NotFound if a policy was deleted. To be called once a deletion can see that it is used."""
        for id in ids:
            if id not in self._given and not await self.claims.settled("policies", id, owner):
                raise missing("policies", id)

    def task(self, about: Description) -> Task:
        """The task of a policy. Raises NotFound for the map, RobotError, and what `make_task` raises."""
        world = self._maps.get(about.map_id)
        try:
            robot = robot_from_json(about.robot)
        except SpecshieldError as error:
            raise error.at("robot") from None
        spec = about.spec
        try:
            regions, signals = spec.get("regions"), spec.get("signals")
            return make_task(
                world.grid, robot, spec["formula"], regions, world.rooms, signals, self._settings.max_horizon
            )
        except FormulaError as error:
            raise error.at("formula").at("spec") if error.path is None else error.at("spec") from None
        except SpecshieldError as error:
            raise error.at("spec") from None

    def policy(self, record: Record) -> Proposer:
        """The policy itself, loaded. Raises PolicyError if it is not ready."""
        return self._recent.get(record.id, lambda: self._load(record))

    def _load(self, record: Record) -> Proposer:
        if record.card is None:
            told = f"policy {record.id} is not ready"
            expected = "a policy whose status is `ready`: wait for it"
            raise PolicyError(told, path="policy_id", got=record.id, expected=expected)
        task = self.task(record.about)
        if record.name is not None:
            return load_policy(self._settings.models_dir / record.name / WEIGHTS, record.card, task)
        return load_policy(self._kept.file(record.id, WEIGHTS), record.card, task)

    def resolve(self, about: Description, owner: str) -> Description:
        """The same description with the map's id in place of its name. Raises NotFound."""
        return replace(about, map_id=self._maps.find(about.map_id, owner).id)

    def described(self, about: Description, task: Task) -> Record:
        """The record for this description, whether the policy exists or not. Its spec, which every session
        stores, keeps only what the formula names. Raises InputError if that is too large.
        """
        spec = dict(about.spec)
        for kind, used in (("regions", task.regions), ("signals", task.signals)):
            if spec.get(kind):
                spec[kind] = {name: value for name, value in spec[kind].items() if name in used}
        size = len(files.to_json(spec))
        if size > (most := self._settings.max_spec_bytes):
            told = "the spec is too large"
            expected = f"at most {most} bytes; only regions that the formula names count"
            raise InputError(told, path="spec", got=f"{size} bytes as JSON", expected=expected)
        id = self._on_map(_id(about, task), about, task)
        return Record(id, replace(about, spec=spec), task.horizon)

    def name(self, record: Record, owner: str, name: str) -> None:
        """Gives a name to an owner's policy. Raises NameTaken."""
        if record.name is None:
            self.claims.name("policies", record.id, owner, name)

    def name_of(self, record: Record, owner: str) -> str | None:
        return record.name or self.claims.name_of("policies", record.id, owner)

    def add_card(
        self, about: Description, card: Mapping[str, Any], weights: bytes, key: Key, name: str | None = None
    ) -> Record:
        """Checks a policy that was made elsewhere, and keeps it. Its id is a hash of all that was sent, so
        that it never replaces another policy or one that is made here. Raises PolicyError.
        """
        try:
            about = self.resolve(about, key.name)
            task = self.task(about)
        except SpecshieldError as error:
            raise PolicyError(error.message, path=error.path, got=error.got, expected=error.expected).at(
                "card"
            ) from None
        record = self.described(about, task)
        card = {**card, "spec": record.about.spec}
        id = self._on_map(sent_id(_id(about, task), card, weights), about, task)
        card["id"] = id  # instead of the sender's
        _check_options(about)
        load_policy(weights, card, task)
        record = replace(record, id=id, card=card)
        if name is not None:
            self.check_name(name, record.id, key.name)
        added = self.add(record, key, {WEIGHTS: weights, "card.json": files.to_json(card)})
        if name is not None:
            self.name(added, key.name, name)
        return added

    def add(self, record: Record, key: Key, trained: Mapping[str, bytes] | None = None) -> Record:
        """Keeps a policy for the owner of the key. trained: its files, if it is made already. Raises
        LimitReached and InsufficientStorage.
        """
        if record.id in self._given:
            return self._given[record.id]
        record = replace(record, created_at=files.now())
        stored = asdict(replace(record, card=None))
        del stored["card"]
        content = {"policy.json": files.to_json(stored), **(trained or {})}
        size = max(sum(map(len, content.values())), self._kept.weight(record.id))
        with self.claims.adding("policies", record.id, key, size, self._own_map(record.about)):
            if self._kept.find(record.id, "policy.json") is None:
                self._kept.write(record.id, content)
        return self.record(record.id)

    def _own_map(self, about: Description) -> str:
        """The id of a policy's map; "" if that came with the server."""
        return "" if self._maps.shipped(about.map_id) is not None else about.map_id

    def _on_map(self, id: str, about: Description, task: Task) -> str:
        """The id of a policy on this map. `id` is the same for all maps with these cells, whatever their
        rooms. It is kept for a map that came with the server, for one without rooms, and for the map for
        which an older version kept the policy; for other maps it is another hash.
        """
        kept = self.made_here(id)
        if kept is None:
            stays = self._own_map(about) in ("", task.grid.content_hash)
        else:
            stays = kept.about.map_id == about.map_id
        return id if stays else hashlib.sha256(f"{id} {about.map_id}".encode()).hexdigest()

    def finish(self, id: str, weights: bytes, card: Mapping[str, Any]) -> None:
        """Writes a policy that a run has made, the card last: it makes the policy ready. Raises NotFound."""
        if self._kept.find(id, "policy.json") is None:
            raise NotFound(f"policy {id} was deleted", path="policy_id", got=id)
        self._kept.write(id, {WEIGHTS: weights, "card.json": files.to_json({**card, "id": id})})
        shutil.rmtree(self.checkpoints(id), ignore_errors=True)  # five times the weights, and not weighed
        if self.given is not None:
            self.claims.weigh("policies", id, self._kept.weight(id))

    def checkpoints(self, id: str) -> Path:
        return self._kept.root / id / "checkpoint"

    def delete(self, record: Record, owner: str, token: str) -> bool:
        """Takes the claim of an owner whose deletion was marked with this token. True if the policy was
        removed with it. Raises Conflict if the mark has expired, StoreError for files that cannot be removed.
        """
        self._kept.check_removable(record.id)
        last = self.claims.free("policies", record.id, owner, token, self._own_map(record.about))
        if last:
            self._recent.drop(record.id)
            self._kept.remove(record.id)
        return last

    def page(self, owner: str, after: str | None, limit: int) -> tuple[list[Record], str | None]:
        """One page of the policies that an owner may use."""
        keys = [*self._named, *self.claims.ids("policies", owner)]
        keys, following = files.page(keys, after, limit, lambda key: self._kept.size(key, *SMALL))
        with ThreadPoolExecutor(AT_ONCE) as pool:  # policies at a URL take long to read
            found = list(pool.map(self.made_here, keys))  # None: not completely written, or deleted by now
        return [record for record in found if record is not None], following

    def _shipped(self) -> Iterator[Record]:
        for path in sorted(self._settings.models_dir.glob("*/card.json")):
            try:
                card = json.loads(path.read_bytes())
                about = describe(card)
                about = replace(about, map_id=self._maps.get(about.map_id).id)
                record = Record(card["id"], about, self.task(about).horizon, path.parent.name, None, card)
            except (SpecshieldError, KeyError, ValueError) as error:
                log.warning("policy %s is left out: %s", path.parent, error)
                continue  # one broken folder must not stop the whole server
            yield record


def describe(card: Mapping[str, Any]) -> Description:
    return Description(*(card[name] for name in ("map_id", "robot", "spec", "method", "seed", "options")))


def _check_options(about: Description) -> None:
    """Raises PolicyError for a wrong value of an option. Unknown options are left out: an older version may
    have had them.
    """
    cls = METHODS.get(about.method).options
    known = {each.name for each in fields(cls)}
    try:
        read_options(cls, {name: value for name, value in about.options.items() if name in known})
    except PolicyError as error:
        raise error.at("card") from None


def sent_id(made_here: str, card: Mapping[str, Any], weights: bytes) -> str:
    """The id of a policy that was made elsewhere: SHA-256, in hex, over the id that it would have if it were
    made here, the rest of the card, and the weights. Ids of policies that are made here hash other members.
    """
    content = {
        "made_of": made_here,
        "card": {name: value for name, value in card.items() if name != "id"},
        "weights": hashlib.sha256(weights).hexdigest(),
    }
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _id(about: Description, task: Task) -> str:
    return policy_id(task.content_hash, about.method, about.options, about.seed)
