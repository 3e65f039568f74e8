"""Servers that do what no server should, each on a port of its own, in a process of its own.

python -m benchmarks.hostile        # prints the ports as JSON, and serves until its input ends
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import socket
import struct
import subprocess
import sys
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager

Fault = Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]]
DRIP = 0.3  # [s] between two bytes
LATE = 0.5  # [s] until a late answer
HEAD = b"HTTP/1.1 200 OK\r\nContent-Type: application/json\r\n"
ANSWER = HEAD + b"Content-Length: 9\r\n\r\n" + b'{"t": 0} '


async def silent(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    await asyncio.sleep(3600)


async def reset(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    await reader.read(100)
    linger = struct.pack("ii", 1, 0)
    writer.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, linger)


async def half_then_reset(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    writer.write(HEAD + b"Content-Length: 9\r\n\r\n{")
    await writer.drain()
    await reset(reader, writer)


async def half_then_silent(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    writer.write(ANSWER[:-3])
    await asyncio.sleep(3600)


async def late(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    await asyncio.sleep(LATE)
    writer.write(ANSWER)


async def drip_head(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    await _drip(writer, HEAD + b"X: " + b"a" * 10_000)


async def drip_body(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    writer.write(HEAD + b"Content-Length: 100000\r\n\r\n")
    await _drip(writer, b" " * 100_000)


async def endless_head(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    writer.write(HEAD)
    await _flood(writer, b"X: " + b"a" * 60 + b"\r\n")


async def endless_continue(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    await _flood(writer, b"HTTP/1.1 100 Continue\r\n\r\n")


async def endless_body(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    writer.write(HEAD + b"\r\n[")
    await _flood(writer, b"0.123456789," * 8)


async def endless_chunks(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    writer.write(HEAD + b"Transfer-Encoding: chunked\r\n\r\n")
    await _flood(writer, b"1\r\n \r\n")


async def garbage(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    await _flood(writer, bytes(range(256)))


async def _drip(writer: asyncio.StreamWriter, content: bytes) -> None:
    for i in range(len(content)):
        writer.write(content[i : i + 1])
        await writer.drain()
        await asyncio.sleep(DRIP)


async def _flood(writer: asyncio.StreamWriter, piece: bytes) -> None:
    block = piece * (65_536 // len(piece))
    for _ in range(100_000):
        writer.write(block)
        await writer.drain()


FAULTS: dict[str, Fault] = {
    each.__name__: each
    for each in (
        silent,
        reset,
        half_then_reset,
        half_then_silent,
        late,
        drip_head,
        drip_body,
        endless_head,
        endless_continue,
        endless_body,
        endless_chunks,
        garbage,
    )
}


async def serve() -> None:
    ports = {}
    for name, fault in FAULTS.items():
        server = await asyncio.start_server(_connection(fault), "127.0.0.1", 0)
        ports[name] = server.sockets[0].getsockname()[1]
    full = socket.create_server(("127.0.0.1", 0), backlog=0)  # its queue is full: it takes no connection
    ports["never_accepts"] = full.getsockname()[1]
    waiting = [socket.socket() for _ in range(4)]
    for each in waiting:
        each.setblocking(False)
        with contextlib.suppress(BlockingIOError):
            each.connect(full.getsockname())
    print(json.dumps(ports), flush=True)
    await asyncio.to_thread(sys.stdin.read)


def _connection(fault: Fault) -> Fault:
    async def handle(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(OSError, asyncio.CancelledError):
            await fault(reader, writer)
        writer.close()

    return handle


@contextmanager
def hostile_servers() -> Iterator[dict[str, int]]:
    """The port of each, for as long as the block lasts."""
    command = [sys.executable, "-m", "benchmarks.hostile"]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert process.stdin is not None
    assert process.stdout is not None
    try:
        yield json.loads(process.stdout.readline())
    finally:
        process.kill()
        process.wait()
        process.stdin.close()
        process.stdout.close()


if __name__ == "__main__":
    asyncio.run(serve())
