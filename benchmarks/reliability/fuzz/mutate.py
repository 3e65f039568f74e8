"""Inputs made from valid ones: bytes changed at random, and JSON trees changed where it hurts (pure)."""

from __future__ import annotations

import copy
import json
import random
from typing import Any

ODD_NUMBERS: list[Any] = [
    0, -1, 1, 2, 3.0, 0.1, -0.0, 1e-300, 1e300, -1e300, 1e308, 1e400, 255, 256, 4000, 4001, 65536,
    2**31, -(2**31), 2**53 + 1, 2**63, -(2**63), 2**64, 10**30, 10**300, float("nan"), float("inf"),
]  # fmt: skip
ODD_VALUES: list[Any] = [
    None, True, False, "", "x", "\x00", "\ud800", "é" * 40, "a" * 5000, "1e5", "nan", [], {}, [[]], [{}],
    {"": None}, [None], [0.0] * 40, "__proto__", "../../etc/passwd", "wall|exterior|0",
]  # fmt: skip
PIECES = [
    b"\x00",
    b"\xff" * 8,
    b"\x80\x00\x00\x00",
    b"9" * 30,
    b"-",
    b"e999",
    b"[" * 50,
    b"{" * 50,
    b'"',
    b"\n",
    b" ",
]
MOST = 20_000  # bytes of a mutated input


def changed_bytes(content: bytes, random: random.Random) -> bytes:
    """A few changes at random places."""
    data = bytearray(content)
    for _ in range(random.choice((1, 1, 1, 2, 3, 8))):
        at = random.randrange(len(data) + 1)
        match random.randrange(7):
            case 0 if data:
                data[at % len(data)] ^= 1 << random.randrange(8)
            case 1 if data:
                data[at % len(data)] = random.randrange(256)
            case 2:
                del data[at : at + random.choice((1, 2, 4, 16, 100))]
            case 3:
                data[at:at] = random.choice(PIECES)
            case 4:
                data[at:at] = data[at : at + random.choice((1, 4, 16, 64))] * random.choice((1, 2, 50))
            case 5:
                data = data[:at]
            case 6:
                other = random.randrange(len(data) + 1)
                data[at:at] = data[other : other + 20]
    return bytes(data[:MOST])


def changed_json(tree: Any, random: random.Random) -> Any:
    """A copy with one to four members changed, taken away, doubled or moved."""
    tree = json.loads(json.dumps(tree))
    for _ in range(random.choice((1, 1, 2, 4))):
        places = list(_places(tree, 2000))
        if not places:
            return _odd(random)
        holder, key = random.choice(places)
        match random.randrange(8):
            case 0 | 1 | 2:
                holder[key] = random.choice(ODD_NUMBERS)
            case 3 | 4:
                holder[key] = _odd(random)
            case 5:
                del holder[key]
            case 6 if isinstance(holder, list):
                holder[key:key] = [holder[key]] * random.choice((1, 3, 300))
            case 6:
                holder[random.choice(["", "x", str(key) * 2, "type", "format"])] = holder[key]
            case 7:
                other, place = random.choice(places)
                if _has(other, place):
                    holder[key] = json.loads(json.dumps(other[place]))
    return tree


def _odd(random: random.Random) -> Any:
    return copy.deepcopy(random.choice(ODD_VALUES))


def dumped(tree: Any) -> bytes:
    """As JSON; NaN and infinities as Python writes them."""
    return json.dumps(tree).encode()


def _places(tree: Any, most: int) -> list[tuple[Any, Any]]:
    found, pending = list[tuple[Any, Any]](), [tree]
    while pending and len(found) < most:
        holder = pending.pop()
        keys = list(holder) if isinstance(holder, dict) else range(len(holder))
        found += [(holder, key) for key in keys]
        pending += [holder[key] for key in keys if isinstance(holder[key], dict | list)]
    return found


def _has(holder: Any, key: Any) -> bool:
    return key in holder if isinstance(holder, dict) else key < len(holder)
