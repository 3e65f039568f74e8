"""Refuses requests that a web page of another origin makes a browser send here.

Any web page may make its visitor's browser send requests to this machine. The page cannot read the answers,
unless its own name is made to point here (DNS rebinding): the Host header then holds that name. So:

- Host has to name the server. On a connection to a loopback address, it is `localhost`, `127.0.0.1` or
  `[::1]`, with the server's port. On others, which may come through a balancer or a port mapping, it is any
  literal address or `localhost`, since nobody can make these point elsewhere; so a probe may use a pod's
  address. SPECSHIELD_ALLOWED_HOSTS has further names. A unix socket takes any Host: no browser reaches it.
- Origin, which a browser sends with every request that may change something, has to be the server itself. So
  has Sec-Fetch-Site, unless a person follows a link.
- A body needs its own Content-Type. Types that a page may send without asking first are refused, except the
  multipart form of an upload, for which the rule on Origin is enough.
"""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any

from specshield.errors import CrossSite, InputError, MisdirectedRequest, UnsupportedMediaType

UPLOADS = ("/v1/maps", "/v1/policies")
AUTHORITY = re.compile(r"(\[[0-9a-f:.]+\]|[a-z0-9._-]+)(?::([0-9]{1,5}))?", re.IGNORECASE)
JSON = re.compile(r"application/(json|[a-z0-9!#$&^_.+-]+\+json)")
WITH_BODY = ("POST", "PUT", "PATCH")
ONCE = (b"host", b"origin", b"authorization", b"content-type")  # headers that say who may do what

Headers = Mapping[bytes, bytes]  # names in lower case


def headers_of(sent: Sequence[tuple[bytes, bytes]]) -> Headers:
    """A request's headers by name. Raises InputError if one of `ONCE` came more than once: a proxy before the
    server may have judged by another one (RFC 9112, section 3.2).
    """
    headers = dict(sent)
    if len(headers) < len(sent):
        names = [name for name, _ in sent]
        for name in ONCE:
            if (count := names.count(name)) > 1:
                told = name.decode().title()
                raise InputError(f"the header {told} came {count} times", path=told, expected="one of it")
    return headers


def check_site(scope: Mapping[str, Any], headers: Headers, allowed: frozenset[str]) -> None:
    """Raises MisdirectedRequest, CrossSite or UnsupportedMediaType. allowed: names, perhaps with a port."""
    host = headers.get(b"host", b"").decode("latin-1").lower()
    server = scope.get("server") or ("", None)
    if not names_server(host, server[0], server[1], allowed):
        raise MisdirectedRequest(
            "this server does not answer for the host that was asked for",
            path="Host",
            got=host,
            expected="the address that the server listens on, or a name in SPECSHIELD_ALLOWED_HOSTS",
        )
    if _from_elsewhere(scope.get("method", ""), headers, host, allowed):
        told = "a page of another origin may not use this server"
        expected = "a program, or a page that comes from this server"
        origin = headers.get(b"origin", b"").decode("latin-1") or None
        raise CrossSite(told, path="Origin", got=origin, expected=expected)
    with_body = headers.get(b"content-length", b"0") != b"0" or b"transfer-encoding" in headers
    if scope.get("method") in WITH_BODY and scope["path"].startswith("/v1/") and with_body:
        _check_type(scope["path"], headers)


@lru_cache(4096)
def names_server(host: str, address: str, port: int | None, allowed: frozenset[str]) -> bool:
    """Whether the header Host names the server behind a socket of this address.

    >>> names_server("localhost:8000", "127.0.0.1", 8000, frozenset())
    True
    """
    found = AUTHORITY.fullmatch(host)
    if found is None:
        return False
    name, named_port = found[1], int(found[2] or 80)
    if port is None or name in allowed or host in allowed:
        return True
    if is_loopback(address):
        return name in ("localhost", "127.0.0.1", "[::1]") and named_port == port
    return name == "localhost" or _literal(name.strip("[]")) is not None


def is_loopback(host: str) -> bool:
    """Whether only this machine can reach a server that listens on this address or name."""
    found = _literal(host)
    if found is None:
        return host == "localhost"
    return (getattr(found, "ipv4_mapped", None) or found).is_loopback


def _literal(text: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(text)
    except ValueError:
        return None


def _from_elsewhere(method: str, headers: Headers, host: str, allowed: frozenset[str]) -> bool:
    origin = headers.get(b"origin")
    if origin is not None:
        scheme, _, authority = origin.decode("latin-1").lower().partition("://")
        if scheme not in ("http", "https") or (authority != host and authority not in allowed):
            return True
    if headers.get(b"sec-fetch-site", b"none") in (b"same-origin", b"none"):
        return False
    fetched = (method, headers.get(b"sec-fetch-mode"), headers.get(b"sec-fetch-dest"))
    return fetched != ("GET", b"navigate", b"document")  # a link that somebody follows, not a frame


def _check_type(path: str, headers: Headers) -> None:
    names = b"content-type", b"content-encoding"
    declared, coding = (headers.get(name, b"").decode("latin-1") for name in names)
    kind = declared.partition(";")[0].strip().lower()
    taken = ["application/json"]
    if path.rstrip("/") in UPLOADS:
        taken.append("multipart/form-data")
    elif path.endswith("/steps"):
        taken.append("application/msgpack")
    if kind not in taken and not JSON.fullmatch(kind):
        told = "the body's Content-Type is not accepted here"
        expected = f"the header Content-Type: {' or '.join(taken)}"
        raise UnsupportedMediaType(told, path="Content-Type", got=declared, expected=expected)
    if coding.lower() not in ("", "identity"):
        told, expected = "a compressed body is not accepted", "the body as it is, without this header"
        raise UnsupportedMediaType(told, path="Content-Encoding", got=coding, expected=expected)
