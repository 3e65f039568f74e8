"""Connections to a store of the Redis protocol: one server, one behind sentinels, or a cluster.

    redis://HOST:PORT/DB   rediss://...?ssl_ca_certs=FILE   unix:///PATH
    redis+sentinel://HOST:PORT,HOST:PORT/SERVICE/DB     the sentinels, and what they call the server
    redis+cluster://HOST:PORT,HOST:PORT                 some nodes of the cluster

`rediss+sentinel` and `rediss+cluster` are the same over TLS. Before the hosts there may be USER:PASSWORD@,
which is for the store; options after a ? are redis-py's, as in ?ssl_ca_certs=/etc/ca.pem.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote, urlsplit

import redis
import redis.asyncio
import redis.asyncio.cluster
import redis.asyncio.retry
import redis.asyncio.sentinel
import redis.cluster
import redis.connection
import redis.exceptions
import redis.retry
import redis.sentinel
from redis.backoff import ExponentialBackoff, NoBackoff

from specshield.errors import StoreError

if TYPE_CHECKING:
    from specshield.service.settings import Settings

FORMS = (
    "redis://127.0.0.1:6379/0, rediss://..., unix:///path, redis+sentinel://h1,h2/service, redis+cluster://h1"
)
# What a client raises if the store cannot be reached or does not understand. RedisClusterException, for a
# cluster of which no node answers, is no RedisError.
FAILURES = (redis.RedisError, redis.exceptions.RedisClusterException, OSError)
CONNECTIONS = 64  # of one server process to a single store; further calls wait for one
TRIES = 3  # after the first one, all within the caller's time limit. Chosen by hand.
JOBS = "{specshield}:rq"  # how rq's keys begin in a cluster, so that one node of it has them all
USER = "a user of the store with the rights that docs/scale.md lists"
REFUSED = re.compile("NOPERM|ACL failure in script|user executing the script")  # as Redis and Valkey say it
PORTS = {"sentinel": 26379, "cluster": 6379}


@contextmanager
def reaching() -> Iterator[None]:
    """Within the block, an error of the connection to the store becomes a StoreError."""
    try:
        yield
    except (*FAILURES, RuntimeError) as error:
        if isinstance(error, RuntimeError) and "handler is closed" not in str(error):
            raise  # uvloop's error for a connection that the other side has closed says that
        raise away(error) from error


@contextmanager
def naming(settings: Settings) -> Iterator[None]:
    """Within the block, a StoreError names the setting REDIS_URL, if it is set. For commands."""
    try:
        yield
    except StoreError as error:
        if settings.redis_url is not None:
            with_cause(error).at("REDIS_URL")
        raise


def with_cause(error: StoreError) -> StoreError:
    """The same error, which now says why. For commands: the cause may name a host or a user of the store,
    which is not for those who send requests.
    """
    error.message += cause_of(error)
    return error


def cause_of(error: StoreError) -> str:
    """Why, in brackets, for the log; "" where the message of the error says it already."""
    # After " : <" redis-py shows its clients of the sentinels.
    cause = str(error.__cause__ or "").partition(" : <")[0][:200]
    return f" ({cause})" if cause not in error.message else ""


def away(error: BaseException) -> StoreError:
    if isinstance(error.__cause__, redis.ResponseError):  # a connection was given up because of this reply
        error = error.__cause__
    if isinstance(error, redis.exceptions.NoPermissionError) or REFUSED.search(str(error)):
        return StoreError("the store refuses: its user lacks a right", expected=USER)
    if isinstance(error, redis.ResponseError):  # its text says why: the memory is full, it is a replica, ...
        return StoreError(f"the store refuses: {error!s:.200}")
    return StoreError(f"the store cannot be reached: {type(error).__name__}")


class _Cluster(redis.asyncio.cluster.RedisCluster):
    """A cluster's client. When a node is gone, redis-py closes every connection to discover the nodes again,
    also those on which other tasks are about to write. Such a write fails with an AttributeError, which here
    becomes a ConnectionError as for any store that cannot be reached.
    """

    async def initialize(self, *args: Any, **kwargs: Any) -> Any:
        """redis-py asks the first master what commands there are, and if that one is gone, asks it again at
        each call, whichever node has the keys. So here the next call, or the next try, begins with another.
        """
        tried = 0
        while True:
            tried += 1
            try:
                return await super().initialize(*args, **kwargs)
            except BaseException as error:  # also a caller whose time is over
                masters, known = self.get_primaries(), self.nodes_manager.nodes_cache
                for first in masters[:1]:
                    known[first.name] = known.pop(first.name)
                if tried >= len(masters) or not isinstance(error, redis.ConnectionError | redis.TimeoutError):
                    raise

    async def execute_command(self, *args: Any, **kwargs: Any) -> Any:
        try:
            return await super().execute_command(*args, **kwargs)
        except AttributeError as error:
            raise redis.ConnectionError("the connection was closed while it was in use") from error


def connect(url: str, blocking: bool = False, **options: Any) -> Any:
    """A client for this URL, for asyncio unless `blocking`. A cluster's blocking client connects at once.

    options: redis-py's, for every connection. Raises ValueError for a URL that has none of the forms above.
    """
    kit: Any = redis if blocking else redis.asyncio
    kind = urlsplit(url).scheme.partition("+")[2]
    # A blocking caller tries again only after a lost connection: a silent store would hold it each time.
    only: Any = {"supported_errors": (redis.ConnectionError,)} if blocking else {}
    retry = kit.retry.Retry(ExponentialBackoff(cap=0.2, base=0.02), TRIES, **only)
    options = {"retry": retry, "socket_connect_timeout": options.get("socket_timeout"), **options}
    if not kind:
        parts = urlsplit(url)
        if "://" not in url or (parts.scheme != "unix" and parts.path.strip("/").strip("0123456789")):
            raise ValueError("no such form, or a database that is no number: redis-py would take database 0")
        pool: Any = kit.BlockingConnectionPool if not blocking else kit.ConnectionPool
        waits = {"max_connections": CONNECTIONS, "timeout": options.get("socket_timeout")}
        return kit.Redis.from_pool(pool.from_url(url, **options, **({} if blocking else waits)))
    hosts, names, found = _parse(url)
    options = {**options, **found}
    if kind == "cluster":
        if names:
            raise ValueError("a cluster has no databases and no services")
        node, of = kit.cluster.ClusterNode, kit.cluster.RedisCluster if blocking else _Cluster
        return of(startup_nodes=[node(*host) for host in hosts], **options)
    if kind != "sentinel" or not 1 <= len(names) <= 2:
        raise ValueError("no such form")
    limits = {name: value for name, value in options.items() if name.startswith(("socket_", "ssl"))}
    # A sentinel that is gone leaves time to ask the others: redis-py would try it again for seconds.
    limits["retry"] = kit.retry.Retry(NoBackoff(), 0)
    if (longest := options["socket_connect_timeout"]) is not None:
        share = longest / (len(hosts) + 1)
        limits |= {"socket_timeout": share, "socket_connect_timeout": share}
    sentinels = kit.sentinel.Sentinel(hosts, sentinel_kwargs=limits)
    return sentinels.master_for(names[0], db=int(names[1]) if names[1:] else 0, **options)


def connect_to_jobs(url: str, **options: Any) -> Any:
    """A blocking client for rq's worker, which knows no clusters: for the node that has its keys."""
    if not is_cluster(url):
        return connect(url, blocking=True, **options)
    cluster = connect(url, blocking=True, socket_timeout=options.get("socket_connect_timeout"))
    node = cluster.get_node_from_key(JOBS)
    cluster.close()
    return redis.Redis(host=node.host, port=node.port, **{**options, **_parse(url)[2]})


def drops(store: Any) -> str | None:
    """A warning about a store that drops keys once its memory is full; None if it keeps them all, or does not
    say. store: a blocking client.
    """
    with suppress(*FAILURES):  # a managed store may refuse the command
        told = store.info("memory")
        policy = told.get("maxmemory_policy", "noeviction")
        if told.get("maxmemory") and policy != "noeviction":
            return f"the store drops steps that were answered once its memory is full: its policy is {policy}"
    return None


def is_cluster(url: str) -> bool:
    return urlsplit(url).scheme.endswith("+cluster")


def _parse(url: str) -> tuple[list[tuple[str, int]], list[str], Mapping[str, Any]]:
    """The hosts, the names in the path, and redis-py's arguments for user, password, TLS and options."""
    parts = urlsplit(url)
    scheme, _, kind = parts.scheme.partition("+")
    if scheme not in ("redis", "rediss") or kind not in PORTS:
        raise ValueError("no such form")
    user, _, listed = parts.netloc.rpartition("@")
    hosts = []
    for host in listed.split(","):
        one = urlsplit(f"//{host}")
        if not one.hostname:
            raise ValueError("a host without a name")
        hosts.append((one.hostname, one.port or PORTS[kind]))
    parse: Any = redis.connection.parse_url  # makes numbers and booleans of the texts in the URL
    found: dict[str, Any] = parse(f"redis://{user}@?{parts.query}")
    found |= {"ssl": True} if scheme == "rediss" else {}
    return hosts, [unquote(name) for name in parts.path.split("/") if name], found
