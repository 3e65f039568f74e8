"""A process that has imported what a command needs, and has its kernels: tests fork `specshield` from it.

    python -m tests.template     # standard input is a socket from `tests.serving`

A fork takes 10 ms, where a new interpreter needs a second or two of a processor until it serves. What a fork
runs is the command line, `specshield.cli.main`, with arguments, environment, files and a session of its own.
The server that a command starts is a fork of the command, a server's process for heavy work and its worker
are forks of the server, and the worker's second process one of the worker.
"""

from __future__ import annotations

import asyncio
import atexit
import contextlib
import ctypes
import gc
import importlib
import json
import math
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable
from functools import cache
from multiprocessing import get_context
from types import SimpleNamespace
from typing import IO, Any

import typer
from PIL import Image

from specshield import cli
from specshield.lookahead.preferences import PREFERENCES
from specshield.policy.methods import METHODS
from specshield.service.heavy import child, heavy, pool
from specshield.service.startup import Startup, prepare
from specshield.service.training import children, worker
from specshield.sim import campaign, service
from specshield.world.formats import FORMATS
from tests.serving import ADDED, READ_AT_IMPORT, ROBOTS

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
BEGUN_WITH = {**os.environ}
EVALUATION = ("evaluation.plan", "scipy.stats")  # before the first command that needs them: a second


def main(control: socket.socket) -> None:
    """Forks for each socket that is sent, until the test's process has ended."""
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    gc.disable()  # `prepare` collects again
    _import(SERVER + COMMANDS)
    Image.preinit()  # of Pillow, whose formats are imported with the first map
    asyncio.run(prepare(Startup()))
    _read_signatures()
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


def _read_signatures() -> None:
    """Those of all commands, which typer reads again in each process: 20 ms of a processor."""
    read = typer.main.get_params_from_function = cache(typer.main.get_params_from_function)
    for command in (cli._about, *cli._commands()):
        group = isinstance(command, typer.Typer)
        for each in [one.callback for one in command.registered_commands] if group else [command]:
            read(each)


def _keep(told: socket.socket) -> None:
    """Forks the command that the test asks for. Tells it the process id, and at the end the exit status."""
    with told.makefile() as asked:
        command = json.loads(asked.readline())
    pid = os.fork()
    if pid == 0:
        told.close()
        os.setsid()
        try:
            _run(**command)
            code = 0
        except SystemExit as ended:
            code = ended.code
        _finish(code)
    with contextlib.suppress(BrokenPipeError):  # nobody asks any more
        told.sendall(f"{pid}\n".encode())
        code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
        told.sendall(f"{code}\n".encode())
    os._exit(0)


def _run(arguments: list[str], environment: dict[str, str], stdout: str, stderr: str, cwd: str) -> None:
    """As the console script runs."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    for stream, path in ((1, stdout), (2, stderr)):
        file = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o600)
        os.dup2(file, stream)
        os.close(file)
    os.chdir(cwd)
    os.environ.clear()
    os.environ.update(environment)
    tempfile.tempdir = None  # TMPDIR is another one now
    if ADDED in environment:
        _add(environment[ADDED])
    sys.argv = ["specshield", *arguments]
    main_module = sys.modules["__main__"]
    main_module.__spec__ = main_module.__package__ = None  # which `python -m` has set
    main_module.__file__ = cli.__file__  # which processes that it spawns import, and would import all of this
    if arguments[:1] == ["serve"]:
        prepared = _prepared()
        heavy.Template = lambda: prepared  # type: ignore[assignment,misc]
        if environment.get("SPECSHIELD_WORKER") != "false":
            children.subprocess = _with(_waiting(prepared._control))
    elif arguments[:1] == ["worker"]:
        _name(arguments[-1])
        if "--learner" not in arguments:
            worker.subprocess = _with(_waiting())
    else:
        service.subprocess = _with(_own_server)
        if ROBOTS in environment:
            campaign.get_context = lambda _: get_context("fork")  # type: ignore[assignment,return-value]
    cli.main()


def _add(folder: str) -> None:
    """Packages in this folder are installed too, here and in whatever process is begun from here."""
    if folder not in sys.path:
        sys.path.insert(0, folder)
        path = os.pathsep.join(filter(None, [folder, os.environ.get("PYTHONPATH")]))
        os.environ["PYTHONPATH"] = BEGUN_WITH["PYTHONPATH"] = path
        for registry in (METHODS, FORMATS, PREFERENCES):
            vars(registry).pop("_points", None)  # which it has read already


def _with(popen: Callable[..., Any]) -> Any:
    """The module `subprocess`, which begins processes this way."""
    return SimpleNamespace(**vars(subprocess) | {"Popen": popen})


def _name(name: str) -> None:
    """What `tests.serving.command_line` tells of this process: all forks have the template's arguments."""
    ctypes.CDLL(None).prctl(15, name.encode())  # PR_SET_NAME


def _own_server(command: list[str], **options: Any) -> Any:
    """The server that a command starts, while the command has no threads."""
    environment = options["env"]
    if any(environment.get(name) != BEGUN_WITH.get(name) for name in READ_AT_IMPORT):
        return subprocess.Popen(command, **options)
    forked = Fork()
    if forked.pid == 0:
        try:
            options["preexec_fn"]()
            log = f"/proc/self/fd/{options['stdout'].fileno()}"
            _run(command[3:], environment, log, log, ".")
            _end(0)
        except SystemExit as ended:
            _end(ended.code)
        except BaseException:
            traceback.print_exc()
            _end(1)
    return forked


def _prepared() -> pool.Template:
    """One that has begun already: its process is forked while the server has no threads."""
    prepared = pool.Template()
    prepared._control, theirs = socket.socketpair()
    prepared._process = Fork()  # type: ignore[assignment]
    if prepared._process.pid == 0:
        prepared._control.close()
        os.setsid()
        if theirs.recv(1, socket.MSG_PEEK):  # it reads its settings when it is wanted, not before
            child.template(theirs)
        os._exit(0)
    theirs.close()
    return prepared


def _waiting(control: socket.socket | None = None) -> Callable[..., Any]:
    """Begins workers. The first has been forked already, while this process has no threads. It ends with this
    process, and where it is not wanted too. control: of this process alone.
    """
    ours, theirs = socket.socketpair()
    heard, told = os.pipe()
    forked = Fork()
    if forked.pid == 0:
        ours.close()
        os.close(told)
        if control is not None:
            control.close()
        asked, _held, _, _ = socket.recv_fds(theirs, 1, 8)  # which it holds as long as it runs
        if not asked:
            os._exit(0)
        with theirs.makefile() as lines:
            command = json.loads(lines.readline())
        os.dup2(heard, 0)
        os.setsid()
        try:
            _run(**command, stdout="/proc/self/fd/1", stderr="/proc/self/fd/2", cwd=".")
            code = 0
        except SystemExit as ended:
            code = ended.code
        _finish(code)
    theirs.close()
    os.close(heard)
    forked.stdin = os.fdopen(told, "wb")
    used = False

    def begin(command: list[str], **options: Any) -> Any:
        nonlocal used
        if used:
            return subprocess.Popen(command, **options)
        used = True
        asked = {"arguments": command[3:], "environment": dict(options.get("env", os.environ))}
        socket.send_fds(ours, [b"."], options["pass_fds"])
        ours.sendall(json.dumps(asked).encode() + b"\n")
        return forked

    return begin


def _finish(code: Any) -> None:
    """As an interpreter ends that does not take its modules apart at last. That would write to all the memory
    that is shared with the template: 60 ms of a processor.
    """
    threading._shutdown()  # type: ignore[attr-defined]
    atexit._run_exitfuncs()
    _end(code)


def _end(code: Any) -> None:
    """As an interpreter ends, without the command's part of the stack."""
    if isinstance(code, str):
        print(code, file=sys.stderr)
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(1 if isinstance(code, str) else code or 0)


class Fork:
    """A child of this process. It has of a Popen what is used."""

    stdin: IO[bytes]

    def __init__(self) -> None:
        self.pid = os.fork()
        self._code: int | None = None

    def poll(self) -> int | None:
        if self._code is None:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            self._code = os.waitstatus_to_exitcode(status) if pid else None
        return self._code

    def terminate(self) -> None:
        self._send(signal.SIGTERM)

    def kill(self) -> None:
        self._send(signal.SIGKILL)

    def _send(self, number: int) -> None:
        if self.poll() is None:
            os.kill(self.pid, number)

    def wait(self, timeout: float = math.inf) -> int:
        deadline = time.monotonic() + timeout
        while (code := self.poll()) is None:
            if time.monotonic() > deadline:
                raise subprocess.TimeoutExpired("specshield", timeout)
            time.sleep(0.01)
        return code


if __name__ == "__main__":
    main(socket.socket(fileno=os.dup(0)))
