"""Reads what callers upload, mostly in a child process: the server itself reads only short formulas.

The functions that a child runs take the settings first, and return what the server needs for its answer.
"""

from __future__ import annotations

import codecs
import math
import re
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import msgspec
from pydantic import BaseModel, ValidationError
from pydantic_core import from_json
from python_multipart.exceptions import FormParserError
from python_multipart.multipart import create_form_parser

from specshield import stl
from specshield.drawing.rules import avoided, windows
from specshield.errors import BodyTooLarge, FormulaError, FragmentError, InputError, PolicyError
from specshield.policy.methods import METHODS
from specshield.policy.options import options_to_json, read_options
from specshield.policy.progress.obligations import obligations
from specshield.service.access.keys import Key
from specshield.service.library.claims import Claims
from specshield.service.library.maps import Maps
from specshield.service.library.policies import Description, Policies, Record, describe
from specshield.service.problems import from_validation
from specshield.service.schemas.base import ID, ID_TOLD
from specshield.service.schemas.policies import Card, PolicyRequest
from specshield.service.schemas.specs import SpecRequest
from specshield.service.settings import Settings
from specshield.service.training.jobs import Jobs
from specshield.task import names_for, parse_regions, parse_signals
from specshield.world.formats import read_map

M = TypeVar("M", bound=BaseModel)
Content = bytes | Path  # a body, or the file that it is in
FILES = "map_server"  # the format of maps that are sent as files without a `format`
PARTS = {"weights": "policy.safetensors", "card": "card.json"}
MOST_PARTS = 16  # of a multipart body
MOST_WINDOWS = 100  # of a formula that the answer shows


@cache
def policies_of(settings: Settings) -> Policies:
    return Policies(settings, _maps(settings))


@cache
def _maps(settings: Settings) -> Maps:
    jobs = Jobs(settings)
    return Maps(settings, _Finishing(lambda: jobs.redis, settings))


class _Finishing(Claims):
    """Claims whose files are written, or which are given back, even if `Pool` ends this process meanwhile: a
    claim without files would count for ever.
    """

    @contextmanager
    def adding(self, *args: Any, **kwargs: Any) -> Iterator[None]:
        before = signal.signal(signal.SIGTERM, signal.SIG_IGN)
        try:
            with super().adding(*args, **kwargs):
                yield
        finally:
            signal.signal(signal.SIGTERM, before)


def add_map(settings: Settings, content_type: str, content: Content, key: Key) -> dict[str, Any]:
    if is_multipart(content_type):
        members: dict[str, Any] = dict(_parts(content_type, content))
        name = members.pop("format", FILES.encode()).decode(errors="replace")
        named = members.pop("name", b"").decode(errors="replace") or None
        made = read_map(name, members, files=True)
    else:
        members = _object(_bytes(content))
        named = members.pop("name", None)
        made = read_map(members.pop("format", None), members)
    return _maps(settings).add(*made, key, _named(named)).to_json()


def _named(name: Any) -> str | None:
    """The name in an upload. Raises InputError unless it has the form of an id."""
    if name is not None and not (isinstance(name, str) and re.fullmatch(ID, name)):
        raise InputError("this is no name", path="name", got=name, expected=ID_TOLD)
    return name


def draw_map(settings: Settings, key: str, owner: str) -> bytes:
    return _maps(settings).find(key, owner).png()


def add_policy(settings: Settings, content_type: str, content: Content, key: Key) -> Record:
    """Keeps a policy that was made elsewhere."""
    files = _parts(content_type, content)
    name = _named(files.pop("name").decode(errors="replace")) if "name" in files else None
    if files.keys() != PARTS.keys():
        expected = " and ".join(PARTS)
        raise InputError("these are not a policy's parts", path="body", got=sorted(files), expected=expected)
    if (got := len(files["card"])) > (limit := settings.max_body_bytes):
        expected = f"at most {limit} bytes"
        raise BodyTooLarge("the card is too large", path="card", got=got, expected=expected, limit=limit)
    card = parse(Card, files["card"], "card").model_dump(exclude_unset=True)
    for path, number in _numbers(card, "card"):
        if not math.isfinite(number):
            raise PolicyError("not a finite number", path=path, got=number, expected="a finite number")
    return policies_of(settings).add_card(describe(card), card, files["weights"], key, name)


def _numbers(value: Any, path: str) -> Iterator[tuple[str, float]]:
    """The floats in JSON, each with its path."""
    if isinstance(value, float):
        yield path, value
    elif isinstance(value, dict):
        for name, member in value.items():
            yield from _numbers(member, f"{path}.{name}")
    elif isinstance(value, list):
        for i, item in enumerate(value):
            yield from _numbers(item, f"{path}[{i}]")


def check_policy(settings: Settings, content: Content, owner: str) -> tuple[Record, str | None]:
    """Checks a request for a policy. Returns the policy that it describes, and its name; keeps nothing."""
    asked = parse(PolicyRequest, _bytes(content))
    body = asked.model_dump(exclude_unset=True)
    method = METHODS.get(asked.method)
    options = read_options(method.options, asked.options)
    robot, settled = body.get("robot", "stretch"), options_to_json(options)
    about = Description(asked.map_id, robot, body["spec"], asked.method, asked.seed, settled)
    policies = policies_of(settings)
    about = policies.resolve(about, owner)
    task = policies.task(about)
    try:
        method.check(task, options)
    except FragmentError as error:
        raise (error if error.path == "robot" else error.at("spec.formula")) from None
    record = policies.described(about, task)
    if asked.name is not None:
        policies.check_name(asked.name, record.id, owner)
    return record, asked.name


def check_spec(settings: Settings, content: bytes, owner: str) -> dict[str, Any]:
    return explain(_maps(settings), settings, content, owner)


def explain(maps: Maps, settings: Settings, content: bytes, owner: str) -> dict[str, Any]:
    """Checks a formula, and returns the answer of /v1/specs/validate."""
    request = parse(SpecRequest, content)
    body = request.model_dump()
    regions = parse_regions(body["regions"] or {})
    signals = parse_signals(body["signals"] or {}, regions)
    rooms = maps.find(request.map_id, owner).rooms if request.map_id else {}
    declared = any(given is not None for given in (request.regions, request.signals, request.map_id))
    names = names_for({**rooms, **regions}, signals) if declared else None
    try:
        formula = stl.parse(request.formula, names=names, max_horizon=settings.max_horizon)
    except FormulaError as error:
        raise error.at("formula") from None
    return {
        "formula": str(formula),
        "horizon": formula.horizon,
        "names": list(formula.names),
        "windows": [window._asdict() for window in windows(formula)][:MOST_WINDOWS],
        "avoided": sorted(avoided(formula)),
        "methods": _methods(formula),
    }


def _methods(formula: stl.Formula) -> list[str]:
    try:
        obligations(formula)
    except FragmentError:
        return ["planner"]
    return ["dqn", "planner", "reachability"]


def is_multipart(content_type: str) -> bool:
    return content_type.lower().startswith("multipart/form-data")


def _parts(content_type: str, content: Content) -> dict[str, bytes]:
    """The parts of a multipart body by name. Raises InputError, also if two parts have the same name."""
    found: list[tuple[str, bytes]] = []

    def note(part: Any) -> None:
        if len(found) == MOST_PARTS:
            raise FormParserError(f"more than {MOST_PARTS} parts")
        name = (part.field_name or b"").decode(errors="replace")
        if hasattr(part, "file_object"):
            part.file_object.seek(0)
            found.append((name, part.file_object.read()))
        else:
            found.append((name, part.value or b""))

    try:
        parser = create_form_parser(
            {"Content-Type": content_type.encode()}, note, note, config={"MAX_MEMORY_FILE_SIZE": 1 << 40}
        )
        parser.write(_bytes(content))
        parser.finalize()
    except (FormParserError, ValueError) as error:
        raise InputError(
            f"the body is not a multipart form: {error}", path="body", expected="multipart/form-data"
        ) from None
    names = [name for name, _ in found]
    if len(set(names)) < len(names):
        raise InputError("two parts have one name", path="body", got=sorted(names), expected="each part once")
    return dict(found)


def _bytes(content: Content) -> bytes:
    return content if isinstance(content, bytes) else content.read_bytes()


def _object(content: bytes) -> dict[str, Any]:
    try:
        members = msgspec.json.decode(content.removeprefix(codecs.BOM_UTF8))
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise InputError(f"the body is not JSON: {error}", expected="a JSON object") from None
    if not isinstance(members, dict):
        raise InputError("the body is not a JSON object", path="body", expected="a JSON object")
    return members


def parse(model: type[M], content: bytes, below: str = "") -> M:
    """`content` as a JSON object of this model. below: the field that it is. Raises InputError."""
    content = content.removeprefix(codecs.BOM_UTF8)  # some editors and shells write one
    try:
        return model.model_validate_json(content)
    except ValidationError as invalid:
        found = [{**item, "loc": ("body", *item["loc"])} for item in invalid.errors(include_url=False)]
        body = None if found[0]["type"] == "json_invalid" else from_json(content)
        raise from_validation(found, body, below) from None
