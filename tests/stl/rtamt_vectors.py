"""Writes data/rtamt.json.gz: random formulas, traces, and rtamt's offline discrete-time robustness at time 0.

    python3 -m venv build/rtamt && build/rtamt/bin/pip install rtamt==0.4.10
    build/rtamt/bin/python tests/stl/rtamt_vectors.py

It needs rtamt and nothing of specshield. Both tools mean the same by every operator here: rtamt's bounded
until, too, asks for its left side on [t, t') only. rtamt has no unary minus on a name, so it is given 0 - x,
and takes no trace of one sample, so each has at least one to spare.
"""

from __future__ import annotations

import gzip
import json
import random
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

import rtamt

OUT = Path(__file__).parent / "data" / "rtamt.json.gz"
SEED, COUNT, DEPTH, MAX_HORIZON = 20240, 400, 4, 40
NAMES = ("x", "y", "Charger1")
WORDS = {"and": "&", "or": "|", "not": "!", "implies": "->", "always": "G", "eventually": "F", "until": "U"}

Texts = tuple[str, str]  # the same thing for specshield and for rtamt


def term(rng: random.Random, depth: int) -> Texts:
    kind = rng.choice(
        ("name", "number", "+", "-", "*", "/", "abs", "neg") if depth else ("name", "name", "number")
    )
    if kind == "name":
        return (rng.choice(NAMES),) * 2
    if kind == "number":
        return (f"{rng.uniform(-3, 3):.2f}",) * 2
    ours, theirs = term(rng, depth - 1)
    if kind == "abs":
        return f"abs({ours})", f"abs({theirs})"
    if kind == "neg":
        return f"-({ours})", f"(0 - {theirs})"
    if kind == "/":
        divisor = f"(abs({rng.choice(NAMES)}) + {rng.uniform(0.5, 2):.2f})"
        return f"({ours}) / {divisor}", f"(({theirs}) / {divisor})"
    right = term(rng, depth - 1)
    return f"({ours}) {kind} ({right[0]})", f"(({theirs}) {kind} ({right[1]}))"


def formula(rng: random.Random, depth: int) -> tuple[Texts, int]:
    """A formula's two texts and its horizon."""
    temporal = ("always", "eventually", "until")
    kind = rng.choice(
        (*temporal, *temporal, "and", "or", "not", "implies", "atom", "<") if depth else ("atom", "<")
    )
    if kind == "atom":
        return (rng.choice(NAMES),) * 2, 0
    if kind == "<":
        op = rng.choice(("<", "<=", ">", ">="))
        left, right = term(rng, 2), term(rng, 2)
        return (f"{left[0]} {op} {right[0]}", f"{left[1]} {op} {right[1]}"), 0
    word = rng.choice((kind, WORDS[kind]))
    a = rng.randint(0, 5)
    b = a + rng.choice((0, 1, rng.randint(0, 9)))
    window = rng.choice((f"[{a},{b}]", f"[{a}:{b}]"))
    (ours, theirs), horizon = formula(rng, depth - 1)
    if kind == "not":
        return (f"{word} ({ours})", f"not({theirs})"), horizon
    if kind in ("always", "eventually"):
        return (f"{word}{window} ({ours})", f"{kind}[{a},{b}]({theirs})"), b + horizon
    right, right_horizon = formula(rng, depth - 1)
    horizon = max(horizon, right_horizon)
    if kind == "until":
        return (
            f"({ours}) {word}{window} ({right[0]})",
            f"({theirs}) until[{a},{b}] ({right[1]})",
        ), b + horizon
    return (f"({ours}) {word} ({right[0]})", f"({theirs}) {kind} ({right[1]})"), horizon


def trace(rng: random.Random, length: int) -> dict[str, list[float]]:
    draw: Callable[[], float] = rng.choice((lambda: rng.gauss(0, 2), lambda: float(rng.randint(-2, 2))))
    return {name: [round(draw(), 3) for _ in range(length)] for name in NAMES}


def offline(text: str, samples: dict[str, list[float]]) -> float:
    spec = rtamt.StlDiscreteTimeSpecification()
    for name in NAMES:
        spec.declare_var(name, "float")
    spec.spec = text
    spec.parse()
    length = len(samples[NAMES[0]])
    return float(
        spec.evaluate({"time": list(range(length)), **{k: list(v) for k, v in samples.items()}})[0][1]
    )


def main() -> None:
    rng = random.Random(SEED)
    vectors = []
    while len(vectors) < COUNT:
        (ours, theirs), horizon = formula(rng, rng.randint(1, DEPTH))
        if horizon > MAX_HORIZON or len(ours) > 600:
            continue
        samples = trace(rng, horizon + 2 + rng.randint(0, 2))
        vectors.append(
            {"formula": ours, "horizon": horizon, "samples": samples, "robustness": offline(theirs, samples)}
        )
    content = {"rtamt": version("rtamt"), "seed": SEED, "vectors": vectors}
    OUT.parent.mkdir(exist_ok=True)
    OUT.write_bytes(gzip.compress(json.dumps(content, separators=(",", ":")).encode(), 9, mtime=0))
    print(f"{len(vectors)} vectors, {OUT.stat().st_size} bytes")


if __name__ == "__main__":
    main()
