"""Network connections that keep the time limit of a whole try, whatever the other side does.

httpx limits each read and each write, so a server that sends a byte now and then holds a call for ever. Here
each operation, from looking up the server's name to the last byte, gets the time that is left of the try.
With asyncio the try is cancelled instead.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import socket
import ssl
import threading
import time
from collections.abc import Callable, Iterable
from concurrent.futures import Future, wait
from contextvars import ContextVar
from functools import cache
from ipaddress import ip_address
from typing import Any, TypeVar, cast
from urllib.request import getproxies, proxy_bypass

import httpcore
import httpx

T = TypeVar("T")
ENDS: ContextVar[float] = ContextVar("ENDS", default=float("inf"))  # when this try ends, time.monotonic() [s]
PARSING = 6e-6  # [s] a byte: h11 takes 1.3 to 3 us for endless "100 Continue" (benchmarks/deadline.py)
LEAST = 512  # bytes that are read at once however little time is left
OPTIONS = [(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)]


def left(error: type[httpcore.TimeoutException], most: float | None = None) -> float:
    """The seconds that are left of this try, at most `most`. Raises `error` if none are left."""
    seconds = ENDS.get() - time.monotonic()
    if seconds <= 0.0:
        raise error("the time of this try is over")
    return min(seconds, threading.TIMEOUT_MAX if most is None else most)


def paced(most: int) -> int:
    """How many bytes to read at once: at most `most`, and no more than can be parsed in the time left."""
    return max(min(most, LEAST), int(min(left(httpcore.ReadTimeout) / PARSING, most)))


class _Around:
    """inner: httpcore's own connection, plain or TLS."""

    def __init__(self, inner: Any) -> None:
        self._inner = inner

    def get_extra_info(self, info: str) -> Any:
        return self._inner.get_extra_info(info)


class Stream(_Around, httpcore.NetworkStream):
    """One connection."""

    def read(self, max_bytes: int, timeout: float | None = None) -> bytes:
        return bytes(self._inner.read(paced(max_bytes), left(httpcore.ReadTimeout, timeout)))

    def write(self, buffer: bytes, timeout: float | None = None) -> None:
        """Writes piece by piece, as the other side reads."""
        connection: socket.socket = self._inner.get_extra_info("socket")
        unsent = memoryview(buffer)
        try:
            while unsent:
                connection.settimeout(left(httpcore.WriteTimeout, timeout))
                unsent = unsent[connection.send(unsent) :]
        except TimeoutError as error:
            raise httpcore.WriteTimeout(str(error)) from error
        except OSError as error:
            raise httpcore.WriteError(str(error)) from error

    def close(self) -> None:
        self._inner.close()

    def start_tls(
        self, ssl_context: ssl.SSLContext, server_hostname: str | None = None, timeout: float | None = None
    ) -> Stream:
        if self.get_extra_info("ssl_object") is not None:
            raise httpcore.UnsupportedProtocol("https through a proxy that is itself reached by https")
        limit = left(httpcore.ConnectTimeout, timeout)
        return Stream(self._inner.start_tls(ssl_context, server_hostname, limit))


class Network(httpcore.NetworkBackend):
    """Connects to a server: tries each of its addresses, with equal shares of the time."""

    def connect_tcp(
        self,
        host: str,
        port: int,
        timeout: float | None = None,
        local_address: str | None = None,
        socket_options: Iterable[Any] | None = None,
    ) -> Stream:
        by = time.monotonic() + left(httpcore.ConnectTimeout, timeout)
        addresses = look_up(host, port, by)
        for number, address in enumerate(addresses):
            share = max(by - time.monotonic(), 1e-3) / (len(addresses) - number)
            try:
                return Stream(
                    httpcore.SyncBackend().connect_tcp(
                        address, port, left(httpcore.ConnectTimeout, share), local_address, OPTIONS
                    )
                )
            except (httpcore.ConnectError, httpcore.ConnectTimeout):
                if number + 1 == len(addresses):
                    raise
        raise httpcore.ConnectError(f"{host} has no address")


def look_up(host: str, port: int, by: float) -> list[str]:
    """The addresses of a host. A thread looks up a name, since the resolver takes no time limit."""
    with contextlib.suppress(ValueError):
        return [str(ip_address(host))]
    asked = in_thread(lambda: socket.getaddrinfo(host, port, type=socket.SOCK_STREAM), by)
    if not asked.done():
        raise httpcore.ConnectTimeout(f"the address of {host} could not be looked up in time")
    try:
        return list(dict.fromkeys(str(entry[4][0]) for entry in asked.result()))
    except (OSError, UnicodeError) as error:  # UnicodeError: no name can be written like this
        raise httpcore.ConnectError(str(error)) from error


def in_thread(
    function: Callable[[], T], by: float, late: Callable[[Future[T]], object] | None = None
) -> Future[T]:
    """Runs a function in a thread, waits for it until `by` (time.monotonic() [s]), and returns its future.
    The interpreter does not wait for the thread at its exit, as it would for an executor's thread. late: is
    called with a future that is done only after the wait, which an interrupt (Ctrl-C) may end too.
    """
    given, done = Future[T](), set[Future[T]]()

    def run() -> None:
        try:
            given.set_result(function())
        except BaseException as error:
            given.set_exception(error)

    try:  # an interrupt may come while the thread is started, too
        try:
            threading.Thread(target=run, daemon=True, name="specshield-client").start()
        except RuntimeError as error:  # the machine has no thread left
            given.set_exception(OSError(str(error)))
        done = wait([given], max(by - time.monotonic(), 0.0)).done
    finally:
        if not done and late is not None:
            given.add_done_callback(late)
    return given


def is_direct(host: str) -> bool:
    """Whether no proxy leads to a host: it is this machine, or the environment excepts it. What a proxy takes
    for 127.0.0.1 is itself.
    """
    here = host == "localhost"
    with contextlib.suppress(ValueError):
        here = ip_address(host).is_loopback
    return here or bool(proxy_bypass(host))


class AsyncStream(_Around, httpcore.AsyncNetworkStream):
    """One connection for asyncio. Only the size of each read is bounded: a late try is cancelled."""

    async def read(self, max_bytes: int, timeout: float | None = None) -> bytes:
        return bytes(await self._inner.read(paced(max_bytes), timeout))

    async def write(self, buffer: bytes, timeout: float | None = None) -> None:
        await self._inner.write(buffer, timeout)

    async def aclose(self) -> None:
        await self._inner.aclose()

    async def start_tls(
        self, ssl_context: ssl.SSLContext, server_hostname: str | None = None, timeout: float | None = None
    ) -> AsyncStream:
        return AsyncStream(await self._inner.start_tls(ssl_context, server_hostname, timeout))


class AsyncNetwork(httpcore.AnyIOBackend):
    async def connect_tcp(self, *args: Any, **options: Any) -> AsyncStream:
        try:
            return AsyncStream(await super().connect_tcp(*args, **options))
        except RuntimeError as error:  # the machine has no thread left, to look up the name
            raise httpcore.ConnectError(str(error)) from error


class Transport(httpx.HTTPTransport):
    """httpx's transport with the network above. It uses the HTTP proxy that the environment names.

    A forked process opens its own connections: requests of two processes over one connection get mixed up.
    """

    def __init__(self, url: httpx.URL) -> None:
        super().__init__(verify=_certificates())
        self._url = url
        self._connect()

    def _connect(self) -> None:
        self._process = os.getpid()
        _connect_by(self, self._url, Network(), httpcore.ConnectionPool, httpcore.HTTPProxy)

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        if self._process != os.getpid():
            self._connect()
        return super().handle_request(request)


class AsyncTransport(threading.local, httpx.AsyncHTTPTransport):
    """The same for asyncio. Each thread has its own connections, and opens new ones for each event loop."""

    def __init__(self, url: httpx.URL) -> None:
        super().__init__(verify=_certificates())
        self._url, self._loop = url, cast(asyncio.AbstractEventLoop | None, None)

    async def handle_async_request(self, request: httpx.Request) -> httpx.Response:
        if self._loop is not (loop := asyncio.get_running_loop()):
            network, self._loop = AsyncNetwork(), loop
            _connect_by(self, self._url, network, httpcore.AsyncConnectionPool, httpcore.AsyncHTTPProxy)
        return await super().handle_async_request(request)

    async def aclose(self) -> None:
        if self._loop is asyncio.get_running_loop():
            await super().aclose()


def _connect_by(transport: Any, url: httpx.URL, network: object, direct: Any, through_proxy: Any) -> None:
    """Gives a transport an unlimited pool of connections on this network: no step waits for a free one."""
    if "_pool" not in vars(transport):
        raise RuntimeError(f"httpx {httpx.__version__} cannot be given a network; expected 0.27 or 0.28")
    proxy = _proxy(url)
    pool = through_proxy if proxy else direct
    transport._pool = pool(
        **proxy, ssl_context=_certificates(), network_backend=network, max_connections=None
    )


@cache
def _certificates() -> ssl.SSLContext:
    """The certificates that this machine trusts. A process reads them once, since that takes 20 ms."""
    return httpx.create_ssl_context()


def _proxy(url: httpx.URL) -> dict[str, Any]:
    """The arguments of httpcore's proxy for this URL; {} if the environment names no proxy for it."""
    proxies = getproxies()
    named = proxies.get(url.scheme) or proxies.get("all")
    if not named or is_direct(url.host):
        return {}
    proxy = httpx.Proxy(named if "://" in named else f"http://{named}")
    at = proxy.url
    place = httpcore.URL(scheme=at.raw_scheme, host=at.raw_host, port=at.port, target=b"/")
    return {"proxy_url": place, "proxy_auth": proxy.raw_auth}
