"""Where the SDK meets httpx: requests in its words, its replies and errors in ours."""

from __future__ import annotations

import re
from typing import Any

import httpx

from specshield.client.wire import Failure, Reply, Request
from specshield.errors import InputError, TransportError, TransportTimeout

PREPARING = 30.0  # s at least for what prepares something: a map, a policy, a session


def address(base_url: str) -> httpx.URL:
    """InputError unless it is the address of a server."""
    try:
        url = httpx.URL(base_url)
    except httpx.InvalidURL:
        url = httpx.URL("")
    if url.scheme not in ("http", "https") or not url.host:
        raise InputError(
            "this is not the address of a server",
            path="base_url",
            got=base_url,
            expected="http://host:port or https://host:port",
        )
    return url


def headers(api_key: str | None) -> dict[str, str]:
    """InputError for a key that no header can carry."""
    if api_key is not None and not re.fullmatch(r"[!-~]([ -~]*[!-~])?", api_key):
        raise InputError(
            "the API key cannot be sent in a header",
            path="api_key",
            expected="ASCII without control characters",
        )
    return {} if api_key is None else {"Authorization": f"Bearer {api_key}"}


def allowed(request: Request, timeout: float) -> float:
    """Seconds this request may take: `timeout`, and at least 30 s where the server prepares something."""
    return max(timeout, PREPARING) if request.slow else timeout


def arguments(request: Request, timeout: float) -> dict[str, Any]:
    """The keywords of httpx's `request`; connecting never gets more than `timeout`."""
    return {
        "method": request.method,
        "url": request.path,
        "params": request.params,
        "content": request.body,
        "files": request.files,
        "headers": None if request.body is None else {"Content-Type": "application/json"},
        "timeout": httpx.Timeout(allowed(request, timeout), connect=timeout),
    }


def check_open(http: httpx.Client | httpx.AsyncClient) -> None:
    if http.is_closed:
        raise TransportError("the client is closed", expected="a client that is still open")


def reply(response: httpx.Response, seconds: float, timeout: float) -> Reply:
    names = {name.lower(): value for name, value in response.headers.items()}
    return Reply(response.status_code, names, response.content, seconds, timeout)


def failure(
    error: httpx.RequestError, request: Request, base_url: httpx.URL, seconds: float, timeout: float
) -> Failure:
    """Every way httpx can fail to bring an answer is a TransportError; its own error is the cause."""
    what = f"{request.method} {str(base_url).rstrip('/')}{request.path}"
    mapped: TransportError
    if isinstance(error, httpx.TimeoutException):
        mapped = TransportTimeout(f"no answer within {timeout:g} s: {what}")
    else:
        mapped = TransportError(
            f"the server cannot be reached: {str(error) or type(error).__name__}: {what}",
            expected="a specshield server that runs at this address",
        )
    mapped.__cause__ = error
    return Failure(mapped, seconds, timeout)
