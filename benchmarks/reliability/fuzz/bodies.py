"""Fuzzed request bodies of the hot route, through the whole application in this process.

A robot's step, as JSON and as MessagePack, sent to a session that exists. A status of 500 is a find, and so
is an answer that is no problem document.
"""

from __future__ import annotations

import asyncio
import contextlib
import io
import json
import random
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec

from benchmarks.reliability.fuzz.mutate import changed_bytes, changed_json, dumped
from benchmarks.reliability.fuzz.targets import Target
from specshield.errors import InputError

STEP: dict[str, Any] = {
    "t": 0,
    "poses": [[5.0, 5.0, 0.0]],
    "logits": [2.0, 0.5, 0.5, -1.0, -4.0, None, 0.0, 0.0, *[None] * 12],
    "main_task_done": False,
    "witnesses": False,
    "signals": {},
}
SESSIONS = 16  # one for the steps in a row that decide something


class Application:
    """The service, its store embedded, spoken to without a network."""

    def __init__(self) -> None:
        from specshield.service.app import create_app
        from specshield.service.settings import Settings

        folder = Path(tempfile.mkdtemp(prefix="fz"))
        self._app = create_app(Settings(data_dir=folder, worker=False))
        self._loop = asyncio.new_event_loop()
        self._life = contextlib.AsyncExitStack()
        self._loop.run_until_complete(
            self._life.enter_async_context(self._app.routes.router.lifespan_context(self._app.routes))
        )
        ends = self._loop.time() + 600.0
        while self.ask("GET", "/readyz", b"", "")[0] != 200 and self._loop.time() < ends:
            self._loop.run_until_complete(asyncio.sleep(0.05))
        for i in range(SESSIONS):
            body = {"id": f"fuzz-{i}", "policy_id": "case1", "initial_pose": [5.0, 5.0, 0.0]}
            status, content = self.ask("POST", "/v1/sessions", json.dumps(body).encode(), "application/json")
            assert status == 201, content

    def ask(self, method: str, path: str, body: bytes, kind: str) -> tuple[int, bytes]:
        """Status and body of the answer."""
        scope = {
            "type": "http",
            "asgi": {"version": "3.0"},
            "http_version": "1.1",
            "method": method,
            "scheme": "http",
            "path": path,
            "raw_path": path.encode(),
            "query_string": b"",
            "root_path": "",
            "headers": [
                (b"host", b"127.0.0.1:8000"),
                (b"content-type", kind.encode()),
                (b"content-length", str(len(body)).encode()),
            ],
            "client": ("127.0.0.1", 1),
            "server": ("127.0.0.1", 8000),
            "app": self._app,
        }
        answered: list[Any] = []
        asked = [{"type": "http.request", "body": body, "more_body": False}]

        async def receive() -> Any:
            return asked.pop() if asked else {"type": "http.disconnect"}

        async def send(message: Any) -> None:
            answered.append(message)

        self._loop.run_until_complete(self._app(scope, receive, send))
        return answered[0]["status"], b"".join(each.get("body", b"") for each in answered[1:])

    def close(self) -> None:
        self._loop.run_until_complete(self._life.aclose())


def step_target(binary: bool) -> Target:
    made: list[Application] = []
    kind = "application/msgpack" if binary else "application/json"
    encode: Callable[[Any], bytes] = _packed if binary else dumped

    def make(chance: random.Random) -> bytes:
        body = STEP if chance.random() < 0.5 else {**STEP, "t": chance.randrange(200)}
        content = encode(changed_json(body, chance))
        return content if chance.random() < 0.6 else changed_bytes(content, chance)

    def feed(content: bytes) -> None:
        if not made:
            made.append(Application())
        path = f"/v1/sessions/fuzz-{len(content) % SESSIONS}/steps"
        status, answer = made[0].ask("POST", path, content, kind)
        if status == 200:
            return
        told = json.loads(answer)
        assert 400 <= status < 500, f"{status} {answer[:300]!r}"
        assert told["status"] == status, answer[:300]
        raise InputError(told["detail"])

    return Target(make, feed)


def _packed(tree: Any) -> bytes:
    """As MessagePack; numbers that it cannot hold and lone surrogates as what is nearest."""
    try:
        return msgspec.msgpack.encode(tree)
    except (OverflowError, UnicodeEncodeError):
        return msgspec.msgpack.encode(json.loads(json.dumps(tree).replace("\\ud800", "?"), parse_int=float))


def record_target() -> Target:
    """`specshield verify` on a session's record: its bytes changed, or its parts changed and sealed again."""
    from specshield.service import verify
    from specshield.service.sessions import chain
    from specshield.service.settings import Settings

    application, steps = Application(), 6
    pose = STEP["poses"][0]
    for t in range(steps):
        body = {**STEP, "t": t, "poses": [pose]}

        path = "/v1/sessions/fuzz-0/steps"
        _, answer = application.ask("POST", path, json.dumps(body).encode(), "application/json")
        decision = json.loads(answer)
        pose = decision["next_poses"][decision["action"]]
    status, seed = application.ask("GET", "/v1/sessions/fuzz-0/record", b"", "")
    assert status == 200, seed[:300]
    application.close()
    parts = msgspec.msgpack.decode(seed)
    folder = Path(tempfile.mkdtemp(prefix="fr"))
    settings = Settings(data_dir=folder)

    def make(chance: random.Random) -> bytes:
        if chance.random() < 0.4:
            return changed_bytes(seed, chance)
        config, rows, left = parts["config"], parts["rows"], list(parts["steps"])
        match chance.randrange(3):
            case 0:
                config = dumped(changed_json(json.loads(config), chance))
            case 1:
                rows = changed_bytes(rows, chance)
            case 2:
                at = chance.randrange(len(left))
                left[at] = changed_bytes(left[at], chance)
        try:
            return chain.pack(config, rows, left)[0]
        except (msgspec.MsgspecError, ValueError, UnicodeDecodeError):
            return msgspec.msgpack.encode({**parts, "config": config, "rows": rows, "steps": left})

    def feed(content: bytes) -> None:
        (folder / "record").write_bytes(content)
        with contextlib.redirect_stdout(io.StringIO()):
            status = verify.verify(folder / "record", settings)
        if status:
            raise InputError("not as it was")

    return Target(make, feed)
