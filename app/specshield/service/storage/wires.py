"""One connection as in wire.py for each node of a cluster. redis-py knows which node has a key."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from contextlib import suppress
from itertools import count
from typing import Any

import anyio
import redis.asyncio
from redis.backoff import NoBackoff
from redis.crc import key_slot

from specshield.service.storage.wire import PART, Script, Wire, too_few

ELSEWHERE = ("MOVED", "ASK", "TRYAGAIN")  # replies of a node whose keys have moved, or are about to move


class Wires:
    """cluster: redis-py's client. timeout, replicas: as `Wire` has them."""

    def __init__(self, cluster: Any, timeout: float, replicas: int) -> None:
        self._cluster, self._timeout, self._replicas = cluster, timeout, replicas
        self._wires: dict[str, Wire] = {}  # by the names of the nodes
        self._looking: asyncio.Task[None] | None = None

    async def run(self, script: Script, keys: Sequence[str], args: Sequence[Any]) -> Any:
        """As `Wire.run`, on the node that has the keys. If that node has lost the keys, redis-py runs the
        script: it follows the node's reply to another node, and remembers it.
        """
        try:
            with anyio.fail_after(self._timeout):
                return await self._run(script, keys, args)
        except (TimeoutError, redis.TimeoutError):
            self._look_again()
            raise

    async def of_each(self, name: str) -> list[str]:
        """As `Wire.of_each`: a key for each master that has slots."""
        if not self._cluster.get_nodes():
            await self._cluster.initialize()
        masters = {slot: nodes[0].name for slot, nodes in self._cluster.nodes_manager.slots_cache.items()}
        keys, left = (f"{name}:{n}" for n in count()), set(masters.values())
        found = list[str]()
        while left:
            key = next(keys)
            if (master := masters.get(key_slot(key.encode()))) in left:
                left.remove(master)
                found.append(key)
        return found

    def _look_again(self) -> None:
        """Starts a task that asks which node has which keys: a silent node would use up a caller's time."""
        if self._looking is None or self._looking.done():
            self._looking = asyncio.create_task(self._look())

    async def _look(self) -> None:
        with suppress(Exception):  # the next caller sees for itself
            await self._cluster.nodes_manager.initialize()

    async def _run(self, script: Script, keys: Sequence[str], args: Sequence[Any]) -> Any:
        if not self._cluster.get_nodes():
            await self._cluster.initialize()
        try:
            return await self._to(self._cluster.get_node_from_key(keys[0])).run(script, keys, args)
        except redis.ConnectionError:
            pass
        except redis.ResponseError as error:
            if str(error).startswith("CLUSTERDOWN"):  # perhaps only this node is cut off from the others
                self._look_again()
            if not str(error).startswith(ELSEWHERE):
                raise
        return await self._sent_on(script, keys, args)

    def _to(self, node: Any) -> Wire:
        wire = self._wires.get(node.name)
        if wire is None:
            for gone in self._wires.keys() - {each.name for each in self._cluster.get_nodes()}:
                self._wires.pop(gone).close()
            # As in redis-py, the cluster's client tries again, and not each connection.
            options = {**node.connection_kwargs, "retry": redis.asyncio.retry.Retry(NoBackoff(), 0)}
            wire = Wire(lambda: node.connection_class(**options), self._timeout, self._replicas)
            self._wires[node.name] = wire
        return wire

    async def _sent_on(self, script: Script, keys: Sequence[str], args: Sequence[Any]) -> Any:
        written = await self._cluster.eval(script.text, len(keys), *keys, *args)
        if self._replicas:
            # WAIT covers all that the node has done before the last write on this connection. So the script
            # runs again, which shows that the node has, and still has, what was written.
            node, longest = self._cluster.get_node_from_key(keys[0]), int(PART * 1000 * self._timeout)
            pipe = self._cluster.pipeline()
            pipe.execute_command("EVAL", script.text, len(keys), *keys, *args, target_nodes=node)
            pipe.execute_command("WAIT", self._replicas, longest, target_nodes=node)
            found, count = await pipe.execute()
            one, other = (each if isinstance(each, bytes) else each[2] for each in (written, found))
            if one != other or count < self._replicas:
                raise too_few(count, self._replicas)
        return written

    def close(self) -> None:
        if self._looking is not None:
            self._looking.cancel()
        for wire in self._wires.values():
            wire.close()
