"""What is fuzzed: for each reader, how an input is made and how it is fed.

An input is the body of a request, or the text of a formula. `feed` raises a
SpecshieldError for an input that is refused; anything else that it raises is a find.
"""

from __future__ import annotations

import io
import json
import math
import random
import struct
import tempfile
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from benchmarks.reliability.fuzz import grammar
from benchmarks.reliability.fuzz.mutate import ODD_NUMBERS, changed_bytes, changed_json, dumped
from specshield.errors import InsufficientStorage, LimitReached
from specshield.service.settings import Settings
from specshield.shipped import MAPS, MODELS

FORMULAS = (
    "F[0,60] (Charger1 or Charger2) and G[0,150] not Forbidden",
    "F[50,100] Kitchen and G[0,150] (Charger1 -> F[0,10] battery > 2.5e1)",
    "(x - 2 * abs(y)) / 3 >= -theta U[3,9] not G[0:4] Kitchen",
    "G not touches(Kitchen)",
)

KEPT = 20  # accepted maps and policies that are kept; what comes after is read and refused
BOUNDARY = b"a-boundary-of-the-fuzzer"
FORM = f"multipart/form-data; boundary={BOUNDARY.decode()}"
JSON = "application/json"


@dataclass(frozen=True)
class Target:
    """make: a new input from this source of chance. feed: reads it."""

    make: Callable[[random.Random], bytes]
    feed: Callable[[bytes], object]


def formula_target() -> Target:
    from specshield.stl import parse

    def feed(content: bytes) -> None:
        made = parse(content.decode(errors="surrogateescape"), max_horizon=1000)
        assert parse(str(made)) == made, "str() of a formula does not parse back to it"

    def make(chance: random.Random) -> bytes:
        text = grammar.formula(chance).encode() if chance.random() < 0.5 else chance.choice(FORMULAS).encode()
        return text if chance.random() < 0.4 else changed_bytes(text, chance)

    return Target(make, feed)


def map_server_target() -> Target:
    """YAML and image, as a multipart body."""
    yamls, images = [_yaml()], _images()
    yamls += [path.read_bytes() for path in sorted(MAPS.glob("*.yaml"))[:2]]
    keys = ("resolution", "origin", "negate", "occupied_thresh", "free_thresh", "mode")
    odd = [*ODD_NUMBERS, "[1,2]", "!!python/object:os.system x", "&a [*a]", "0x1F", "1:30", "{}"]

    def make(chance: random.Random) -> bytes:
        text, image = chance.choice(yamls), chance.choice(images)
        if chance.random() < 0.3:
            text += f"\n{chance.choice(keys)}: {chance.choice(odd)}\n".encode()
        elif chance.random() < 0.6:
            text = changed_bytes(text, chance)
        if chance.random() < 0.6:
            image = changed_bytes(image, chance)
        elif chance.random() < 0.2:
            sides = [chance.choice((0, 1, 7, 3999, 4000, 4001, 10**9)) for _ in range(2)]
            head = (chance.choice((1, 2, 4, 5, 6)), *sides, chance.choice((0, 1, 255, 65535)))
            image = b"P%d %d %d\n%d\n" % head + bytes(chance.choice((0, 10, 5000)))
        whole = form(metadata=text, image=image)
        return whole if chance.random() < 0.9 else changed_bytes(whole, chance)

    return Target(make, _upload("add_map", FORM))


def grid_target() -> Target:
    from specshield.world.nav_msgs import FORMAT

    return _json_target([{"format": "occupancy_grid", **(FORMAT.example or {})}], _upload("add_map", JSON))


def house_target() -> Target:
    return _json_target([{"format": "procthor", **_house()}], _upload("add_map", JSON))


def spec_target() -> Target:
    from specshield.service.examples import SPEC_REQUEST

    union = {"type": "union", "members": list(SPEC_REQUEST["regions"].values())}
    more = {
        "formula": "F[0,3] All and s > 1",
        "regions": {"All": union},
        "signals": {"s": 1.0},
        "map_id": "case1",
    }
    return _json_target([SPEC_REQUEST, {**more, "map_id": "case1"}], _upload("check_spec"))


def policy_request_target() -> Target:
    from specshield.service.examples import POLICY

    footprint = {"radius": 0.2, "offset": [0.1, 0.0]}
    actions = [
        {"name": "a", "translate": 0.2},
        {"name": "b", "rotate": 0.5},
        {"name": "end", "terminal": True},
    ]
    robot = {"footprint": footprint, "on_contact": "stop", "actions": actions}
    options = {"updates": 5, "exploration": [0.1, 0.2], "reward": "paper"}
    own = {**POLICY, "robot": robot, "method": "dqn", "options": options}
    return _json_target([POLICY, own], _upload("check_policy"))


def policy_target() -> Target:
    """Uploads of policies: a card and a safetensors file, as a multipart body."""
    folder = MODELS / "case1-dqn"
    weights = (folder / "policy.safetensors").read_bytes()
    card = json.loads((folder / "card.json").read_text())

    def make(chance: random.Random) -> bytes:
        head = 8 + struct.unpack("<Q", weights[:8])[0]
        changed = weights
        match chance.randrange(4):
            case 0:
                changed = changed_bytes(weights[:head], chance) + weights[head:]
            case 1:
                tree = changed_json(json.loads(weights[8:head]), chance)
                text = dumped(tree)
                changed = struct.pack("<Q", len(text)) + text + weights[head:]
            case 2:
                at = chance.randrange(head, len(weights) - 8)
                value = chance.choice((math.nan, math.inf, -math.inf, 1e38, 0.0))
                changed = weights[:at] + struct.pack("<f", value) + weights[at + 4 :]
        told = dumped(card) if chance.random() < 0.3 else dumped(changed_json(card, chance))
        told = told if chance.random() < 0.9 else changed_bytes(told, chance)
        return form(weights=changed, card=told)

    return Target(make, _upload("add_policy", FORM))


def _upload(function: str, *kind: str) -> Callable[[bytes], object]:
    """What a process does with such an upload (service/heavy/uploads.py), for a caller without a key."""
    from specshield.service.access.keys import Key
    from specshield.service.heavy import uploads

    settings = _place()
    caller = Key("", "") if function.startswith("add") else ""

    def feed(content: bytes) -> None:
        with suppress(LimitReached, InsufficientStorage):  # it was read, and there is no room for more
            getattr(uploads, function)(settings, *kind, content, caller)

    return feed


@cache
def _place() -> Settings:
    """A data folder of this process with a store, which ends with it."""
    from specshield.service.storage.embedded import EmbeddedStore

    folder = Path(tempfile.mkdtemp(prefix="fuzz-"))
    EmbeddedStore(folder).join()
    return Settings(data_dir=folder, max_maps=KEPT, max_policies=KEPT)


def form(**files: bytes) -> bytes:
    """A multipart body of these files."""
    parts = b""
    for name, content in files.items():
        about = f'Content-Disposition: form-data; name="{name}"; filename="{name}"\r\n\r\n'.encode()
        parts += b"--%b\r\n%b%b\r\n" % (BOUNDARY, about, content)
    return parts + b"--%b--\r\n" % BOUNDARY


def _json_target(seeds: Sequence[Any], feed: Callable[[bytes], object]) -> Target:
    return Target(lambda chance: _json_input(seeds, chance), feed)


def _json_input(seeds: Sequence[Any], chance: random.Random) -> bytes:
    seed = chance.choice(seeds)
    if chance.random() < 0.75:
        return dumped(changed_json(seed, chance))
    return changed_bytes(dumped(seed), chance)


def _yaml() -> bytes:
    return (
        b"image: map.pgm\nmode: scale\nresolution: 0.05\norigin: [-1.5, 2.0, 0.1]\nnegate: 0\n"
        b"occupied_thresh: 0.65\nfree_thresh: 0.25\n"
    )


def _images() -> list[bytes]:
    """Small ones of every kind that is read."""
    import numpy as np
    from PIL import Image

    cells = (np.arange(12 * 9).reshape(9, 12) * 37 % 256).astype(np.uint8)
    found = [
        b"P5\n12 9\n255\n" + cells.tobytes(),
        b"P2\n3 2\n255\n0 1 2 254 255 100\n",
        b"P4\n9 2\n\xff\x80\x00\x00",
    ]
    for mode in ("1", "L", "LA", "P", "RGB", "RGBA", "I;16"):
        deep = Image.fromarray(cells.astype(np.uint16) * 257)
        picture = deep if mode == "I;16" else Image.fromarray(cells).convert(mode)
        file = io.BytesIO()
        picture.save(file, "PNG")
        found.append(file.getvalue())
    return found


def _house() -> dict[str, Any]:
    """One of three rooms with a door, a wall thing and a table with something on it."""

    def point(x: float, z: float, y: float = 0.0) -> dict[str, float]:
        return {"x": x, "y": y, "z": z}

    def room(kind: str, x: float) -> dict[str, Any]:
        return {
            "roomType": kind,
            "floorPolygon": [point(x, 0), point(x + 3, 0), point(x + 3, 4), point(x, 4)],
        }

    def thing(asset: str, x: float, y: float, **more: Any) -> dict[str, Any]:
        turned = {"x": 0.0, "y": 30.0, "z": 0.0}
        return {"assetId": asset, "position": point(x, 2.0, y), "rotation": turned, "kinematic": True, **more}

    walls = [
        {"id": f"wall|{i}", "polygon": [point(x, 0), point(x, 4), point(x, 4, 3), point(x, 0, 3)]}
        for i, x in enumerate((0.0, 3.0, 3.0, 6.0))
    ]
    door = {"wall0": "wall|1", "wall1": "wall|2", "room0": "a", "room1": "b", "openness": 1.0}
    door |= {"holePolygon": [point(1.0, 0.0), point(2.0, 0.0, 2.0)]}
    cup = thing("cup", 1.0, 0.8, kinematic=False)
    return {
        "house": {
            "rooms": [room("Kitchen", 0.0), room("Bedroom", 3.0), room("Bedroom", 6.0)],
            "walls": walls,
            "doors": [door],
            "objects": [thing("table", 1.0, 0.4, children=[cup]), thing("clock", 4.0, 1.8)],
        },
        "asset_sizes": {
            "table": [1.0, 0.8, 0.6],
            "cup": {"x": 0.1, "y": 0.1, "z": 0.1},
            "clock": {"size": [0.3] * 3},
        },
        "resolution": 0.1,
    }
