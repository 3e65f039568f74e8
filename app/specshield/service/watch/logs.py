"""Lines of the log, as text or as JSON (one object in each line). They hold no keys and no bodies.

    logs.tell("session begun", session_id=id)               # at info
    logs.tell("decided", logging.DEBUG, t=3, mode="shaped")

Within a request, its id, its session and its trace (from the header `traceparent`) are added when the line is
written, so they take no time of a request that logs nothing.
"""

from __future__ import annotations

import json
import logging
import re
from contextvars import ContextVar
from datetime import UTC, datetime
from typing import Any

from starlette.types import Scope
from uvicorn.config import LOGGING_CONFIG
from uvicorn.logging import DefaultFormatter

log = logging.getLogger("specshield")
request: ContextVar[Scope | None] = ContextVar("request", default=None)  # the request that is being answered
TRACEPARENT = re.compile(rb"[0-9a-f]{2}-([0-9a-f]{32})-([0-9a-f]{16})-[0-9a-f]{2}")  # W3C Trace Context
# Lines of uvicorn 0.54 that are left out: for a WebSocket that was refused on purpose, for one that sent
# bytes that are not UTF-8, and for one that was opened (there is no line for its end).
NO_NEWS = {
    "ASGI callable returned without completing handshake.",
    "Invalid UTF-8 sequence received from client.",
    "connection open",
}
PLAIN = re.compile(r"[\w.:/{}@+-]+")  # texts that a line shows without quotes


def tell(message: str, level: int = logging.INFO, /, **about: Any) -> None:
    """Logs one line: what happened, and the values that belong to it."""
    if log.isEnabledFor(level):
        log.log(level, message, extra={"about": about})


def owner() -> str:
    """Whose key the request that is being answered has shown; "" for none, and outside of requests."""
    scope = request.get()
    return "" if scope is None else scope["state"].get("owner", "")


def config(form: str, level: str) -> dict[str, Any]:
    """The configuration for uvicorn and logging.config.dictConfig: all lines go to standard error."""
    kind = "specshield.service.watch.logs." + ("Json" if form == "json" else "Text")
    own = {"handlers": ["default"], "level": level.upper(), "propagate": False}
    loggers = {**LOGGING_CONFIG["loggers"], "specshield": own}
    formatters = {"default": {"()": kind, "fmt": "%(levelprefix)s %(message)s"}}
    handlers = {"default": {**LOGGING_CONFIG["handlers"]["default"], "filters": [_is_news]}}
    # Metrics and the lines for refused requests take the place of uvicorn's access log, which takes some 60
    # us.
    del loggers["uvicorn.access"]
    others = {"handlers": ["default"], "level": "WARNING"}  # such as rq and asyncio
    own_parts = {"formatters": formatters, "handlers": handlers, "loggers": loggers, "root": others}
    return {**LOGGING_CONFIG, **own_parts}


def _is_news(record: logging.LogRecord) -> bool:
    if str(record.msg).startswith('%s - "WebSocket %s"') and isinstance(record.args, tuple):
        client, path, *others = record.args
        record.args = client, str(path).partition("?")[0], *others  # a caller may put its key into the query
    return record.getMessage() not in NO_NEWS


class Text(DefaultFormatter):
    """uvicorn's form, followed by the values: `INFO:     session begun  session_id=a`."""

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802
        if record.name == log.name:  # a newline in a caller's path must not begin another line
            record.message = record.message.replace("\r", "\\r").replace("\n", "\\n")
        shown = " ".join(f"{name}={_plain(value)}" for name, value in _about(record).items())
        return super().formatMessage(record) + (f"  {shown}" if shown else "")


class Json(logging.Formatter):
    """An object with time, level, logger, message, the values, and the traceback if there is one."""

    def __init__(self, **_: Any) -> None:
        super().__init__()

    def format(self, record: logging.LogRecord) -> str:
        line: dict[str, Any] = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
            **_about(record),
        }
        if record.exc_info:
            line["exception"] = self.formatException(record.exc_info)
        return json.dumps(line, default=str)


def _about(record: logging.LogRecord) -> dict[str, Any]:
    about: dict[str, Any] = dict(getattr(record, "about", ()))
    scope = request.get()
    if scope is None:
        return about
    session = scope.get("path_params", {}).get("session_id")
    if session is not None:
        about.setdefault("session_id", session)
    about["request_id"] = scope["state"].get("request_id")
    if traced := TRACEPARENT.fullmatch(dict(scope["headers"]).get(b"traceparent", b"")):
        about |= {"trace_id": traced[1].decode(), "span_id": traced[2].decode()}
    return about


def _plain(value: Any) -> str:
    text = f"{value:.6g}" if isinstance(value, float) else str(value)
    return text if PLAIN.fullmatch(text) else json.dumps(text)
