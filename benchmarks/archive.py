"""Moves steps to the archive and reads them back, byte for byte.

    python -m benchmarks.archive                  # a million steps
    python -m benchmarks.archive --steps 100000 --place s3://bucket/prefix

The sessions are episodes of the stand-in model in the paper's second case, decided here. Each is put into the
store under ids of its own, moved by the server's own mover, and read back as the routes read it.
"""

from __future__ import annotations

import argparse
import asyncio
import hashlib
import json
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.states import along
from evaluation.shipped import shipped
from specshield import episode
from specshield.service.sessions import record
from specshield.service.sessions.mover import Mover
from specshield.service.sessions.state import State
from specshield.service.settings import Settings
from specshield.service.storage.archive import Archive
from specshield.service.storage.archiving import FENCE, RETURN, ArchivingStore
from specshield.service.storage.embedded import EmbeddedStore
from specshield.service.storage.objects import open_objects
from specshield.service.storage.store import Dump, keys
from specshield.shield.decision import make_shield
from specshield.sim.cases import load_case

TTL = 7 * 24 * 3600  # [s] the server's own
ROOM = 200  # sessions that are in the store at a time, as many as would be robots that are alive
AT_ONCE = 8  # that are read back side by side


def episodes(count: int, seed: int) -> list[Dump]:
    """Sessions as the store would have them, each ended."""
    case = load_case("case2")
    shield = make_shield([shipped(case, "reachability")])
    found: list[Dump] = []
    steps: list[bytes] = []
    for state in along(case, shield, count, seed):
        if state.t <= len(steps) - 1:  # the next episode
            steps = []
        done = state.logits is None
        decision = episode.decide(shield, state.history, state.logits, done, carry=state.carry)
        row, last = state.history[-1], steps[-1] if steps else b""
        asked = record.Asked(row.tolist(), state.logits, done)
        made = record.make(decision, asked, row, [], record.digest(last))
        steps += [b""] * (state.t - len(steps)) + [record.encode(made)]
        ended = State(
            len(state.history), state.t + 1, True, decision.spec_status, time.time() + TTL,
            record.digest(steps[-1]), main_task_done=done, finished=True, carry=decision.carry,
        )  # fmt: skip
        config = json.dumps({"spec": case.spec, "actions": list(case.task.robot.action_names)}).encode()
        dump = Dump(config, ended.packed(), b"", state.history.astype("<f8").tobytes(), list(steps))
        if found and state.t > 1 and len(found[-1].steps) < len(steps):
            found[-1] = dump
        else:
            found.append(dump)
    return found


def digest(dump: Dump) -> bytes:
    parts = [dump.config, dump.state, dump.version, dump.rows, *dump.steps]
    lengths = [len(part) for part in parts]
    return hashlib.sha256(repr(lengths).encode() + b"".join(parts)).digest()


async def measure(store: ArchivingStore, archive: Archive, kinds: list[Dump], steps: int) -> dict[str, Any]:
    mover = Mover(store, Settings(archive_after=1, archive_bytes=1 << 50))
    bring = store.redis.register_script(RETURN)
    wanted: dict[str, bytes] = {}
    moved = stored = 0
    spent, peak, began = 0.0, 0, time.perf_counter()
    empty = (await store.redis.info("memory"))["used_memory"]
    while moved < steps:
        names = [f"robot-{len(wanted) + i:07d}" for i in range(ROOM)]
        for i, name in enumerate(names):
            kind = kinds[(len(wanted) + i) % len(kinds)]
            dump = Dump(
                kind.config + name.encode(),
                kind.state,
                b"%040x:%d" % (i, len(kind.steps)),
                kind.rows,
                kind.steps,
            )
            contents = [dump.config, dump.state, dump.rows, *dump.steps]
            await bring(
                keys=[*keys(name), f"specshield:{{{name}}}:left"],
                args=[dump.version, FENCE, TTL * 1000, *contents],
            )
            await store.redis.zadd("specshield:sessions", {name: 0})
            wanted[name] = digest(dump)
            moved += len(dump.steps)
            stored += sum(map(len, contents))
        peak = max(peak, (await store.redis.info("memory"))["used_memory"])
        await asyncio.sleep(1.05)  # all are idle now
        start = time.perf_counter()
        assert await mover.move() == ROOM
        spent += time.perf_counter() - start
        if sys.stderr.isatty():
            print(f"\r{moved:,} steps", end="", file=sys.stderr)
    left = (await store.redis.info("memory"))["used_memory"]
    size = sum(bytes for _, bytes in archive.sizes())

    start, free, wrong = time.perf_counter(), asyncio.Semaphore(AT_ONCE), list[str]()

    async def check(name: str, expected: bytes) -> None:
        async with free:
            dump = await store.dump(name)
        if dump is None or digest(dump) != expected:
            wrong.append(name)

    await asyncio.gather(*(check(*item) for item in wanted.items()))
    read = time.perf_counter() - start
    return {
        "sessions": len(wanted),
        "steps": moved,
        "steps_that_came_back_otherwise": len(wrong),
        "bytes_a_step_in_the_store": round((peak - empty) / (ROOM * moved / len(wanted))),
        "bytes_a_step_as_sent": round(stored / moved),
        "bytes_a_step_in_the_archive": round(size / moved, 1),
        "store_bytes_when_all_had_left": left - empty,
        "moved_steps_a_second": round(moved / spent),
        "moved_sessions_a_second": round(len(wanted) / spent),
        "read_steps_a_second": round(moved / read),
        "read_sessions_a_second": round(len(wanted) / read),
        "seconds": round(time.perf_counter() - began),
    }


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.archive")
    parser.add_argument("--steps", type=int, default=1_000_000, help=f"at least; {ROOM} sessions at a time")
    parser.add_argument("--episodes", type=int, default=8, help="that are unlike each other")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--place", help="folder or fsspec URL; a temporary folder if left out")
    args = parser.parse_args()
    kinds = episodes(args.episodes, args.seed)
    with tempfile.TemporaryDirectory(prefix="specshield-archive-") as folder:
        embedded = EmbeddedStore(Path(folder))
        embedded.join()
        archive = Archive(open_objects(args.place or f"{folder}/archive"))

        async def run() -> dict[str, Any]:
            store = ArchivingStore(embedded.url, 10.0, TTL, archive)
            try:
                return await measure(store, archive, kinds, args.steps)
            finally:
                await store.aclose()

        found = asyncio.run(run())
        embedded.leave()
    print(
        json.dumps(
            {"steps_an_episode": float(np.mean([len(kind.steps) for kind in kinds])), **found}, indent=1
        )
    )
    sys.exit(found["steps_that_came_back_otherwise"] > 0)


if __name__ == "__main__":
    main()
