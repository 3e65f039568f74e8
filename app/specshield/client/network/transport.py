"""Translates between the SDK and httpx: requests, replies and errors."""

from __future__ import annotations

import asyncio
import re
import secrets
import time
from collections.abc import Mapping
from typing import Any

import httpx

from specshield.client.wire import Failure, Reply, Request, stale
from specshield.errors import InputError, TransportError, TransportTimeout

PREPARING = 30.0  # [s] the least time for a request that prepares a map, a policy or a session
MOST = 64 << 20  # [bytes] of an answer; chosen by hand: a step of 256 actions with all its witnesses has 1 MB
MOST_PREPARED = 1 << 30  # [bytes] of the answer of a slow request, such as a long trajectory; chosen by hand
UNDERSTANDING = 1e-7  # [s] kept for parsing each byte; json.loads of a step's answer took 55 ns a byte
STALE = "the answer belongs to another request"
MINE = "X-Request-Id"  # the server sends back what it was sent
LATE = (TimeoutError, asyncio.TimeoutError)  # one and the same from Python 3.11 on


def address(base_url: str) -> httpx.URL:
    """The address of a server as a URL. Raises InputError if it is none."""
    try:
        url = httpx.URL(base_url)
    except (httpx.InvalidURL, TypeError):  # TypeError: it is no text
        url = httpx.URL("")
    if url.scheme not in ("http", "https") or not url.host or (url.port or 0) > 65535:
        expected = "http://host:port or https://host:port, with a port of at most 65535"
        told = "this is not the address of a server"
        raise InputError(told, path="base_url", got=base_url, expected=expected)
    return url


def headers(api_key: str | None) -> dict[str, str]:
    """The headers of every request. Raises InputError for a key that no header can hold."""
    sendable = isinstance(api_key, str) and re.fullmatch(r"[!-~]([ -~]*[!-~])?", api_key)
    if api_key is not None and not sendable:
        expected = "printable ASCII, with no space at either end"
        raise InputError("the API key cannot be sent in a header", path="api_key", expected=expected)
    plain = {"Accept-Encoding": "identity"}  # a small compressed answer could hold very much
    return plain if api_key is None else {**plain, "Authorization": f"Bearer {api_key}"}


class Exchange:
    """One try of a request: its arguments for httpx, its time limit, and how its answer is read.

    timeout: the client's [s]. ends: when the call has to end, on the clock of time.monotonic(). Raises
    TransportError if the client is closed.
    """

    def __init__(
        self, request: Request, http: httpx.Client | httpx.AsyncClient, timeout: float, ends: float
    ) -> None:
        if http.is_closed:
            raise TransportError("the client is closed", expected="a client that is still open")
        self.request, self.began, self._ends, self._base_url = request, time.monotonic(), ends, http.base_url
        self._allowed = max(timeout, PREPARING) if request.slow else timeout
        self.seconds = min(self._allowed, ends - self.began)  # the time of this try; 0 or less: there is none
        self.ends = self.began + self.seconds
        self._most = MOST_PREPARED if request.slow else MOST
        self._id = secrets.token_hex(8)
        self.content = bytearray()

    def arguments(self, timeout: float) -> dict[str, Any]:
        """The arguments of httpx's `stream`. Connecting may never take longer than `timeout`."""
        request, headers = self.request, {MINE: self._id}
        if request.body is not None:
            headers["Content-Type"] = "application/json"
        return {
            "method": request.method,
            "url": request.path,
            "params": request.params,
            "content": request.body,
            "files": request.files,
            "headers": headers,
            "timeout": httpx.Timeout(self.seconds, connect=min(timeout, self.seconds)),
        }

    def begin(self, response: httpx.Response) -> None:
        """Raises httpx.DecodingError for a compressed body: it was not asked for, and may hold very much."""
        encoding = response.headers.get("Content-Encoding", "identity")
        if encoding != "identity":
            raise httpx.DecodingError(f"the answer is compressed by {encoding}, which was not asked for")

    def take(self, chunk: bytes) -> None:
        """Takes a piece of the body. Raises httpx.ReadTimeout if too little time is left to parse it."""
        self.content += chunk
        if len(self.content) > self._most:
            raise httpx.ReadError(f"the answer has more than {self._most} bytes")
        if time.monotonic() + UNDERSTANDING * len(self.content) > self.ends:
            raise httpx.ReadTimeout("the time of this try is over")

    def reply(self, status: int, headers: Mapping[str, str], document: Any = None) -> Reply | Failure:
        """The reply with the body taken so far, or with a document from a stream. A Failure if it belongs to
        another request or is about another step: its connection has to be closed then.
        """
        names = {name.lower(): value for name, value in headers.items()}
        reply = Reply(status, names, bytes(self.content), *self._taken(), parsed=document)
        another = names.get(MINE.lower(), self._id) != self._id
        return self.failure(httpx.ReadError(STALE)) if another or stale(self.request, reply) else reply

    def _taken(self) -> tuple[float, float, float]:
        now = time.monotonic()
        return now - self.began, self._allowed, self._ends - now

    def failure(self, error: Exception) -> Failure:
        """The TransportError for any failure of a connection. Its cause is httpx's error for that."""
        if isinstance(error, LATE):
            error = httpx.ReadTimeout("the time of this try is over")
        elif not isinstance(error, httpx.RequestError):
            error = httpx.ReadError(str(error))
        what = f"{self.request.method} {str(self._base_url).rstrip('/')}{self.request.path}"
        mapped: TransportError
        if isinstance(error, httpx.TimeoutException):
            mapped = TransportTimeout(f"no answer within {max(self.seconds, 0.0):.3g} s: {what}")
        else:
            plain = "; http:// in place of https:// for a server without TLS" if "[SSL" in str(error) else ""
            mapped = TransportError(
                f"the server cannot be reached: {str(error) or type(error).__name__}: {what}",
                expected=f"a specshield server that runs at this address{plain}",
            )
        mapped.__cause__ = error
        return Failure(mapped, *self._taken())
