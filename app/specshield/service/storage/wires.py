"""A connection as in wire.py to each node of a cluster. redis-py knows which node has a key, and opens it."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from typing import Any

import redis
from redis.asyncio.retry import Retry
from redis.backoff import NoBackoff

from specshield.service.storage.connect import reaching
from specshield.service.storage.wire import PART, Script, Wire, too_few

ELSEWHERE = ("MOVED", "ASK", "TRYAGAIN")  # replies of a node whose keys are at another, or on their way there


class Wires:
    """cluster: redis-py's client. timeout, replicas: as `Wire` has them."""

    def __init__(self, cluster: Any, timeout: float, replicas: int = 0) -> None:
        self._cluster, self._timeout, self._replicas = cluster, timeout, replicas
        self._wires: dict[str, Wire] = {}  # by the names of the nodes

    async def run(self, script: Script, keys: Sequence[str], args: Sequence[Any]) -> Any:
        """As `Wire.run`, on the node that has the keys. What this node does not have, or no longer, is asked
        through redis-py, which is sent on to another node and remembers it.
        """
        with reaching():
            async with asyncio.timeout(self._timeout):
                return await self._run(script, keys, args)

    async def _run(self, script: Script, keys: Sequence[str], args: Sequence[Any]) -> Any:
        await self._cluster.initialize()  # does nothing where redis-py knows the nodes
        try:
            return await self._to(self._cluster.get_node_from_key(keys[0])).run(script, keys, args)
        except redis.ConnectionError:
            pass
        except redis.ResponseError as error:
            if str(error).startswith("CLUSTERDOWN"):  # it may be this node alone that is apart from the rest
                await self._cluster.nodes_manager.initialize()
            if not str(error).startswith(ELSEWHERE):
                raise
        return await self._sent_on(script, keys, args)

    def _to(self, node: Any) -> Wire:
        wire = self._wires.get(node.name)
        if wire is None:
            there = {each.name for each in self._cluster.get_nodes()}
            for gone in self._wires.keys() - there:
                self._wires.pop(gone).close()
            # As redis-py does: who asks a cluster tries again, not each connection.
            options = {**node.connection_kwargs, "retry": Retry(NoBackoff(), 0)}
            wire = Wire(lambda: node.connection_class(**options), self._timeout, self._replicas)
            self._wires[node.name] = wire
        return wire

    async def _sent_on(self, script: Script, keys: Sequence[str], args: Sequence[Any]) -> Any:
        written = await self._cluster.eval(script.text, len(keys), *keys, *args)
        if self._replicas:
            await self._replicated(keys[0], written if isinstance(written, bytes) else written[2])
        return written

    async def _replicated(self, key: str, version: bytes | None) -> None:
        """Waits until the replicas of the node that has this key have it; it is still of this version there.
        WAIT is for all that the node had done when the command before it, on the same connection, was done.
        """
        node, longest = self._cluster.get_node_from_key(key), int(PART * 1000 * self._timeout)
        pipe = self._cluster.pipeline()
        pipe.execute_command("HGET", key, "version", target_nodes=node)
        pipe.execute_command("WAIT", self._replicas, longest, target_nodes=node)
        found, count = await pipe.execute()
        if found != version or count < self._replicas:
            raise too_few(count, self._replicas)

    def close(self) -> None:
        for wire in self._wires.values():
            wire.close()
