"""A process that decides states it is told of and times them, for `benchmarks.episodes`.

    python -P benchmarks/answerer.py CASE METHOD      # one JSON document a line, in and out

It takes nothing but the package itself, so that with another PYTHONPATH it times another checkout.
"""

from __future__ import annotations

import gc
import hashlib
import json
import sys
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from specshield.episode import decide, make_shield
from specshield.policy.methods import load_policy
from specshield.shipped import MODELS
from specshield.sim.cases import load_case


def serve(case_name: str, method: str) -> None:
    """{"pose", "logits", "over", "first"}: decides that state, and answers what was decided.

    {"repeats": n}: decides the state told last n times more, with the same carry, and answers the fewest
    nanoseconds of CPU that one decision took.
    """
    case = load_case(case_name)
    folder = MODELS / (case.name if method == "reachability" else f"{case.name}-{method}")
    card = json.loads((folder / "card.json").read_text())
    shield = make_shield([load_policy(folder / "policy.safetensors", card, case.task)])
    poses: list[list[float]] = []
    carry = None
    call: Callable[[], Any] = list
    after = None
    for line in sys.stdin:
        said = json.loads(line)
        if "repeats" in said:
            answer: dict[str, Any] = {"ns": fewest(call, said["repeats"])}
        else:
            poses, carry = ([], None) if said["first"] else (poses, after)
            poses = [*poses, said["pose"]]
            logits = None if said["logits"] is None else np.array(said["logits"])
            call = partial(decide, shield, poses, logits, said["over"], carry=carry)
            decision = call()
            after = decision.carry
            answer = {"digest": digest(decision), "status": decision.spec_status}
        print(json.dumps(answer), flush=True)


def fewest(call: Callable[[], Any], repeats: int) -> int:
    best = sys.maxsize
    gc.disable()
    for _ in range(repeats):
        began = time.thread_time_ns()
        call()
        best = min(best, time.thread_time_ns() - began)
    gc.enable()
    return best


def digest(decision: Any) -> str:
    """Of what a robot is told, and of what the next decision goes by."""
    told = (decision.action, decision.distribution.tolist(), decision.robustness, decision.carry.witnesses)
    return hashlib.sha256(repr(told).encode()).hexdigest()[:16]


if __name__ == "__main__":
    serve(*sys.argv[1:])
