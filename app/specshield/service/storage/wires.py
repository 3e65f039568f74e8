"""A connection as in wire.py to each node of a cluster. redis-py knows which node has a key, and opens it."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from typing import Any

import anyio
import redis.asyncio
from redis.backoff import NoBackoff

from specshield.service.storage.wire import PART, Script, Wire, too_few

ELSEWHERE = ("MOVED", "ASK", "TRYAGAIN")  # replies of a node whose keys are at another, or on their way there


class Wires:
    """cluster: redis-py's client. timeout, replicas: as `Wire` has them."""

    def __init__(self, cluster: Any, timeout: float, replicas: int = 0) -> None:
        self._cluster, self._timeout, self._replicas = cluster, timeout, replicas
        self._wires: dict[str, Wire] = {}  # by the names of the nodes
        self._looking: asyncio.Future[Any] | None = None

    async def run(self, script: Script, keys: Sequence[str], args: Sequence[Any]) -> Any:
        """As `Wire.run`, on the node that has the keys. What this node does not have, or no longer, is asked
        through redis-py, which is sent on to another node and remembers it.
        """
        try:
            with anyio.fail_after(self._timeout):
                return await self._run(script, keys, args)
        except (TimeoutError, redis.TimeoutError):
            self._look_again()
            raise

    def _look_again(self) -> None:
        """Has it asked which node has which keys, by a task: a silent node takes all the time of a caller."""
        if self._looking is None or self._looking.done():
            self._looking = asyncio.gather(self._cluster.nodes_manager.initialize(), return_exceptions=True)

    async def _run(self, script: Script, keys: Sequence[str], args: Sequence[Any]) -> Any:
        if not self._cluster.get_nodes():
            await self._cluster.initialize()
        try:
            return await self._to(self._cluster.get_node_from_key(keys[0])).run(script, keys, args)
        except redis.ConnectionError:
            pass
        except redis.ResponseError as error:
            if str(error).startswith("CLUSTERDOWN"):  # it may be this node alone that is apart from the rest
                self._look_again()
            if not str(error).startswith(ELSEWHERE):
                raise
        return await self._sent_on(script, keys, args)

    def _to(self, node: Any) -> Wire:
        wire = self._wires.get(node.name)
        if wire is None:
            for gone in self._wires.keys() - {each.name for each in self._cluster.get_nodes()}:
                self._wires.pop(gone).close()
            # As redis-py does: who asks a cluster tries again, not each connection.
            options = {**node.connection_kwargs, "retry": redis.asyncio.retry.Retry(NoBackoff(), 0)}
            wire = Wire(lambda: node.connection_class(**options), self._timeout, self._replicas)
            self._wires[node.name] = wire
        return wire

    async def _sent_on(self, script: Script, keys: Sequence[str], args: Sequence[Any]) -> Any:
        written = await self._cluster.eval(script.text, len(keys), *keys, *args)
        if self._replicas:
            # WAIT is for all that the node had done when the command before it, on the same connection, was
            # done: by then it has this version, and still has it.
            node, longest = self._cluster.get_node_from_key(keys[0]), int(PART * 1000 * self._timeout)
            pipe = self._cluster.pipeline()
            pipe.execute_command("HGET", keys[0], "version", target_nodes=node)
            pipe.execute_command("WAIT", self._replicas, longest, target_nodes=node)
            found, count = await pipe.execute()
            if found != (written if isinstance(written, bytes) else written[2]) or count < self._replicas:
                raise too_few(count, self._replicas)
        return written

    def close(self) -> None:
        if self._looking is not None:
            self._looking.cancel()
        for wire in self._wires.values():
            wire.close()
