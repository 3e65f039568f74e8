"""A process that has imported what a command needs, and has its kernels: tests fork `specshield` from it.

    python -m tests.template     # standard input is a socket from `tests.serving`

A fork takes 10 ms, where a new interpreter needs a second or two of a processor until it serves. What a fork
runs is the command line, `specshield.cli.main`, with arguments, environment and files of its own. A server's
process for heavy work is a fork too.
"""

from __future__ import annotations

import asyncio
import contextlib
import gc
import importlib
import json
import os
import signal
import socket
import sys
import tempfile

from PIL import Image

from specshield import cli
from specshield.service.heavy import child, heavy, pool
from specshield.service.startup import Startup, prepare

SERVER = (
    "anyio._backends._asyncio",
    "encodings.idna",
    "uvicorn.lifespan.on",
    "uvicorn.loops.auto",
    "uvicorn.loops.uvloop",
    "uvicorn.protocols.http.httptools_impl",
    "specshield.service.app",
    "specshield.service.bounds.protocol",
    "specshield.service.heavy.uploads",
)
COMMANDS = (
    "evaluation.commands",
    "specshield.commands.check_drive",
    "specshield.commands.doctor",
    "specshield.commands.export",
    "specshield.commands.policy",
    "specshield.commands.run",
    "specshield.commands.watch",
    "specshield.service.access.commands",
    "specshield.sim.demo",
)
EVALUATION = ("evaluation.plan", "scipy.stats")  # before the first command that needs them: a second


def main(control: socket.socket) -> None:
    """Forks for each socket that is sent, until the test's process has ended."""
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    gc.disable()  # `prepare` collects again
    _import(SERVER + COMMANDS)
    Image.preinit()  # of Pillow, whose formats are imported with the first map
    asyncio.run(prepare(Startup()))
    gc.freeze()
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # nobody waits for the keepers
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the commands
    while True:
        sent, descriptors, _, _ = socket.recv_fds(control, 1, 1)
        if not sent:
            break
        if sent == b"e":
            _import(EVALUATION)
        if os.fork() == 0:
            control.close()
            signal.signal(signal.SIGCHLD, signal.SIG_DFL)
            _keep(socket.socket(fileno=descriptors[0]))
            break
        os.close(descriptors[0])


def _import(names: tuple[str, ...]) -> None:
    """What is not installed is told by the command."""
    for name in names:
        with contextlib.suppress(ImportError):
            importlib.import_module(name)
    gc.freeze()


def _keep(told: socket.socket) -> None:
    """Forks the command that the test asks for. Tells it the process id, and at the end the exit status."""
    with told.makefile() as asked:
        command = json.loads(asked.readline())
    pid = os.fork()
    if pid == 0:
        told.close()
        _run(**command)
        return
    with contextlib.suppress(BrokenPipeError):  # nobody asks any more
        told.sendall(f"{pid}\n".encode())
        code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
        told.sendall(f"{code}\n".encode())
    os._exit(0)


def _run(arguments: list[str], environment: dict[str, str], stdout: str, stderr: str, cwd: str) -> None:
    """Its return, or what it raises, ends this process, as with the console script."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    for stream, path in ((1, stdout), (2, stderr)):
        file = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o600)
        os.dup2(file, stream)
        os.close(file)
    os.chdir(cwd)
    os.environ.clear()
    os.environ.update(environment)
    tempfile.tempdir = None  # TMPDIR is another one now
    sys.argv = ["specshield", *arguments]
    main_module = sys.modules["__main__"]
    main_module.__spec__ = main_module.__package__ = None  # which `python -m` has set
    if arguments[:1] == ["serve"]:
        prepared = _prepared()
        heavy.Template = lambda: prepared  # type: ignore[assignment,misc]
    cli.main()


def _prepared() -> pool.Template:
    """One that has begun already: its process is forked while the server has no threads."""
    prepared = pool.Template()
    prepared._control, theirs = socket.socketpair()
    prepared._process = Fork()  # type: ignore[assignment]
    if prepared._process.pid == 0:
        prepared._control.close()
        os.setsid()
        child.template(theirs)  # until the server has ended, if nothing is asked of it
        os._exit(0)
    theirs.close()
    return prepared


class Fork:
    """It has of a Popen what the pool uses."""

    def __init__(self) -> None:
        self.pid = os.fork()
        self._ended = False

    def poll(self) -> int | None:
        self._ended = self._ended or os.waitpid(self.pid, os.WNOHANG)[0] == self.pid
        return 0 if self._ended else None

    def kill(self) -> None:
        if self.poll() is None:
            os.kill(self.pid, signal.SIGKILL)

    def wait(self) -> None:
        if not self._ended:
            os.waitpid(self.pid, 0)
            self._ended = True


if __name__ == "__main__":
    main(socket.socket(fileno=os.dup(0)))
