"""Fuzzed inputs of every reader of what strangers send: python -m benchmarks.reliability fuzz.

The inputs are made in shards of SHARD; what a shard holds depends on seed, target and number alone. Those
that are done are noted, so a run that was cut off goes on where it was. A find is a file under <out>/fuzz/: a
crash (anything but the project's own errors), more than a second of CPU time, or more than 200 MB of memory
above that of the process before. An input that takes more than HANGS on the clock is ended from outside.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
import multiprocessing
import os
import random
import resource
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

from benchmarks.reliability.figures import about, write
from benchmarks.reliability.fuzz.targets import (
    Target,
    formula_target,
    grid_target,
    house_target,
    map_server_target,
    policy_request_target,
    policy_target,
    spec_target,
)

SHARD = 5000  # inputs
WARM = 100  # inputs of another kind of chance, before memory is looked at
SLOW = 1.0  # [s] of CPU time
LARGE = 200 << 20  # bytes above the process before
ROOM = 2 << 30  # bytes of address space above: a safety net for the machine
HANGS = 30.0  # [s] on the clock
ALIKE = 3  # finds of one kind and place that are kept as files


def _steps(binary: bool) -> Target:
    from benchmarks.reliability.fuzz.bodies import step_target

    return step_target(binary)


def _records() -> Target:
    from benchmarks.reliability.fuzz.bodies import record_target

    return record_target()


TARGETS: dict[str, Callable[[], Target]] = {
    "formula": formula_target,
    "map_server": map_server_target,
    "occupancy_grid": grid_target,
    "procthor": house_target,
    "spec": spec_target,
    "policy_request": policy_request_target,
    "policy": policy_target,
    "step_json": partial(_steps, False),
    "step_msgpack": partial(_steps, True),
    "record": _records,
}
SHARES = {
    "formula": 0.35, "map_server": 0.12, "occupancy_grid": 0.10, "procthor": 0.05, "spec": 0.07,
    "policy_request": 0.02, "policy": 0.03, "step_json": 0.13, "step_msgpack": 0.12, "record": 0.01,
}  # fmt: skip


@dataclass(frozen=True)
class Shard:
    target: str
    number: int
    seed: int

    @property
    def name(self) -> str:
        return f"{self.target}-{self.number}"

    def chance(self, i: int) -> random.Random:
        return random.Random(f"{self.seed}/{self.target}/{self.number}/{i}")


def run(out: Path, inputs: int, seed: int, workers: int, names: Sequence[str], command: str) -> int:
    """How many finds there are."""
    folder = out / "fuzz"
    folder.mkdir(parents=True, exist_ok=True)
    done = {line["shard"]: line for line in _lines(folder / "shards.jsonl") if line["seed"] == seed}
    shards = [
        Shard(name, i, seed) for name in names for i in range(max(1, round(inputs * SHARES[name] / SHARD)))
    ]
    todo = [shard for shard in shards if shard.name not in done]
    todo.sort(key=lambda shard: shard.number)  # every target early
    began = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="fz-") as scratch:
        os.environ["TMPDIR"] = scratch  # the data folders of the processes
        for line in _work(todo, folder, workers):
            with open(folder / "shards.jsonl", "a") as file:
                file.write(json.dumps(line) + "\n")
            done[line["shard"]] = line
            print(f"{len(done)} of {len(shards)} shards: {line}", flush=True)
    wanted = {shard.name for shard in shards}
    lines = [line for name, line in done.items() if name in wanted]
    figures = {
        "seed": seed,
        "seconds": round(time.monotonic() - began),
        "targets": _sums(lines),
        **about(command),
    }
    write(out, "fuzz", figures)
    return sum(sum(each["finds"].values()) for each in figures["targets"].values())


def _lines(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def _sums(lines: Sequence[dict[str, Any]]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for line in lines:
        into = found.setdefault(
            line["target"], {"inputs": 0, "accepted": 0, "finds": {}, "slowest_s": 0.0, "largest_mb": 0.0}
        )
        into["inputs"] += line["inputs"]
        into["accepted"] += line["accepted"]
        into["finds"] = dict(Counter(into["finds"]) + Counter(line["finds"]))
        into["slowest_s"] = max(into["slowest_s"], line["slowest_s"])
        into["largest_mb"] = max(into["largest_mb"], line["largest_mb"])
    return found


@dataclass
class Worker:
    """A process that works on one shard after another, and what it was seen to be at."""

    process: Any
    pipe: Connection
    at: Any
    shard: Shard | None = None
    seen: tuple[int, float] = (-1, 0.0)
    lost: Counter[str] = field(default_factory=Counter)

    def give(self, shard: Shard, first: int) -> None:
        self.shard, self.seen = shard, (-1, time.monotonic())
        self.pipe.send((shard, first))

    def hangs(self) -> bool:
        now = time.monotonic()
        if self.at.value != self.seen[0]:
            self.seen = (self.at.value, now)
        # Before its first input a process loads kernels, which takes long on a busy machine.
        return now - self.seen[1] > (HANGS if self.at.value >= 0 else 600.0)


def _start(folder: Path) -> Worker:
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    at = context.Value("q", -1)
    process = context.Process(target=_process, args=(theirs, at, folder), daemon=False)
    process.start()
    theirs.close()
    return Worker(process, ours, at)


def _work(todo: list[Shard], folder: Path, count: int) -> Iterator[dict[str, Any]]:
    """The line of each shard as it is done. A worker that died or hung over an input is replaced, and the
    next one goes on after that input.
    """
    pending = [(shard, 0, Counter[str](), 0) for shard in reversed(todo)]
    busy: list[Worker] = []
    try:
        while pending or busy:
            while pending and len(busy) < count:
                worker = _start(folder)
                busy.append(worker)
                shard, first, worker.lost, _ = pending.pop()
                worker.give(shard, first)
            wait([worker.pipe for worker in busy], timeout=0.5)
            for worker in list(busy):
                shard = worker.shard
                assert shard is not None
                try:
                    line = worker.pipe.recv() if worker.pipe.poll() else None
                except EOFError:
                    line = {"ended": "crash"}
                if line is None and worker.hangs():
                    line = {"ended": "hang"}
                if line is None:
                    continue
                if "ended" in line:
                    i, kind = worker.at.value, line["ended"]
                    if kind == "crash":
                        worker.process.join(10.0)
                    worker.process.kill()
                    worker.process.join()
                    busy.remove(worker)
                    if i < 0:
                        raise RuntimeError(f"a worker does not start on {shard}")
                    _keep(folder, shard, i, kind, f"the process ended: {worker.process.exitcode}")
                    pending.append((shard, i + 1, worker.lost + Counter({kind: 1}), 0))
                    continue
                line["finds"] = dict(Counter(line["finds"]) + worker.lost)
                worker.lost = Counter()
                yield line
                if pending:
                    following, first, worker.lost, _ = pending.pop()
                    worker.give(following, first)
                else:
                    worker.pipe.send(None)
                    worker.process.join(10.0)
                    busy.remove(worker)
    finally:
        for worker in busy:
            worker.process.kill()


def _process(pipe: Connection, at: Any, folder: Path) -> None:
    logging.disable(logging.CRITICAL)  # what libraries say of each broken input
    made: dict[str, Target] = {}
    while (given := pipe.recv()) is not None:
        shard, first = given
        if shard.target not in made:
            made[shard.target] = _warm(TARGETS[shard.target](), shard)
        pipe.send(_shard(made[shard.target], shard, first, at, folder))
        at.value = -1


def _warm(target: Target, shard: Shard) -> Target:
    """Loads what is loaded on first use, and bounds the address space."""
    resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    for i in range(WARM):
        content = target.make(Shard(shard.target, -1, shard.seed).chance(i))
        with contextlib.suppress(Exception):  # finds are counted in the shards
            target.feed(content)
    size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (size + ROOM, resource.RLIM_INFINITY))
    return target


def _shard(target: Target, shard: Shard, first: int, at: Any, folder: Path) -> dict[str, Any]:
    from specshield.errors import SpecshieldError

    finds, accepted, slowest, largest = Counter[str](), 0, 0.0, 0
    for i in range(first, SHARD):
        content = target.make(shard.chance(i))
        at.value = i
        _forget_peak()
        before, began = _peak(), time.process_time()
        problem = ""
        try:
            target.feed(content)
            accepted += 1
        except SpecshieldError as error:
            if isinstance(error.__cause__ or error.__context__, MemoryError):
                problem = "large"
        except BaseException:
            problem = "crash"
            _keep(folder, shard, i, problem, traceback.format_exc(), content)
        took, grown = time.process_time() - began, _peak() - before
        slowest, largest = max(slowest, took), max(largest, grown)
        problem = problem or ("slow" if took > SLOW else "large" if grown > LARGE else "")
        if problem:
            finds[problem] += 1
            if problem != "crash":
                _keep(folder, shard, i, problem, f"{took:.2f} s, {grown / 1e6:.0f} MB", content)
    return {
        "shard": shard.name,
        "seed": shard.seed,
        "target": shard.target,
        "inputs": SHARD - first,
        "accepted": accepted,
        "finds": dict(finds),
        "slowest_s": round(slowest, 3),
        "largest_mb": round(largest / 1e6, 1),
    }


def _keep(folder: Path, shard: Shard, i: int, kind: str, told: str, content: bytes | None = None) -> None:
    """A find as files: the input, and what it did. Those that end alike are kept ALIKE times."""
    if content is None:
        content = TARGETS[shard.target]().make(shard.chance(max(i, 0)))
    place = hashlib.sha256("".join(told.splitlines()[-3:-1]).encode()).hexdigest()[:8]
    name = f"{kind}-{shard.target}-{place}"
    if len(list(folder.glob(f"{name}-*.bin"))) < ALIKE:
        (folder / f"{name}-{shard.number}-{i}.bin").write_bytes(content)
        (folder / f"{name}-{shard.number}-{i}.txt").write_text(told)


def _forget_peak() -> None:
    Path("/proc/self/clear_refs").write_text("5")


def _peak() -> int:
    """The most memory that this process has held since `_forget_peak` [bytes]."""
    text = Path("/proc/self/status").read_bytes()
    at = text.index(b"VmHWM:")
    return int(text[at + 6 : text.index(b"kB", at)]) * 1024
