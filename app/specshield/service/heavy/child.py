"""The processes for heavy work: a template that has imported everything, and forks of it.

    python -m specshield.service.heavy.child     # the template; standard input is a socket from the server

The template forks for each message from the server, which has a socket attached. A fork takes 10 ms, while
importing the core takes a second. The fork serves calls on its socket, one after the other. If the template
cannot fork, it says so on that socket, and goes on. Each process ends when the server closes its socket or
ends.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import importlib
import logging.config
import os
import pickle
import resource
import signal
import socket
import struct
import sys
from typing import Any

from specshield.errors import SpecshieldError
from specshield.service.problems import shortened
from specshield.service.settings import Settings
from specshield.service.storage.objects import unusable
from specshield.service.watch import logs

LIMITS = struct.Struct("<QB")  # most memory [bytes], niceness
LENGTH = struct.Struct("<Q")
NOT_BEGUN = (0, 0)  # what the template sends if it cannot fork, in place of a process id and its memory


def template(control: socket.socket) -> None:
    settings = Settings()
    logging.config.dictConfig(logs.config(settings.log_format, settings.log_level))
    gc.set_threshold(50_000)  # [objects]: collections took a quarter of the time, and modules are never freed
    importlib.import_module("specshield.service.heavy.uploads")
    gc.freeze()  # so that collections in the forks do not write to these pages, which all forks share
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the server
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # nobody waits for the forks
    while True:
        message, descriptors, _, _ = socket.recv_fds(control, LIMITS.size, 1)
        if len(message) < LIMITS.size:
            return
        try:
            pid = os.fork()
        except OSError as error:  # no process or memory is left for it; those that run go on
            logs.log.warning("a process for heavy work cannot be begun: %s", error)
            with contextlib.suppress(ConnectionError), socket.socket(fileno=descriptors[0]) as calls:
                write(calls.makefile("wb"), NOT_BEGUN)
            continue
        if pid == 0:
            control.close()
            signal.signal(signal.SIGCHLD, signal.SIG_DFL)
            signal.signal(signal.SIGTERM, signal.SIG_DFL)  # the server's parent may have had it ignored
            _limit(*LIMITS.unpack(message))
            with contextlib.suppress(ConnectionError), socket.socket(fileno=descriptors[0]) as calls:
                serve(calls)  # until the server closes the socket, as when a caller leaves
            os._exit(0)
        os.close(descriptors[0])


def _limit(memory: int, nice: int) -> None:
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG: ends with its parent
    os.nice(nice)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    # RLIMIT_AS would also count address space that libraries reserve and never use.
    resource.setrlimit(resource.RLIMIT_DATA, (memory, memory))


def serve(calls: socket.socket) -> None:
    """Sends its process id and resident memory, then answers calls (function, arguments) until the end.

    An answer is (value, None, resident memory [bytes]) or (None, error, resident memory).
    """
    stream = calls.makefile("rwb")
    write(stream, (os.getpid(), resident()))
    while len(head := stream.read(LENGTH.size)) == LENGTH.size:
        size = LENGTH.unpack(head)[0]
        call = stream.read(size)
        if len(call) < size:  # the server was killed while it wrote
            return
        write(stream, (*_call(call), resident()))


def _call(call: bytes) -> tuple[Any, BaseException | None]:
    try:
        name, arguments = pickle.loads(call)  # from the server; input of strangers is only bytes in it
        module, _, function = name.partition(":")
        return getattr(importlib.import_module(module), function)(*arguments), None
    except SpecshieldError as error:
        return None, shortened(error).with_traceback(None)
    except MemoryError:
        return None, MemoryError()
    except OSError as error:
        return None, unusable(error)
    except BaseException as error:
        logs.log.exception("a call failed in a process for heavy work")
        return None, RuntimeError(f"{type(error).__name__}; the server's log says more")


def write(stream: Any, value: Any) -> None:
    content = pickle.dumps(value, protocol=5)
    stream.write(LENGTH.pack(len(content)))
    stream.write(content)
    stream.flush()


def resident() -> int:
    """The memory of this process without the part that it shares with the template [bytes]."""
    with open("/proc/self/statm") as file:
        _, total, shared, *_ = map(int, file.read().split())
    return (total - shared) * os.sysconf("SC_PAGE_SIZE")


if __name__ == "__main__":
    with socket.socket(fileno=os.dup(0)) as control:
        template(control)
