"""The `specshield` command. Each subcommand imports what it needs when it runs."""

from __future__ import annotations

import contextlib
import errno
import gc
import json
import logging.config
import os
import signal
import socket
import sys
import traceback
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

from specshield import __version__
from specshield.errors import InputError, SpecshieldError, StoreError

if TYPE_CHECKING:
    from specshield.service.settings import Settings

try:
    import typer
except ImportError:  # the base install is the client
    typer = None  # type: ignore[assignment]

NEEDS_SERVER = """\
This command needs the server's parts: pip install 'specshield[server]'
What is installed here is the client, for Python: from specshield.client import ShieldClient"""

FAILED = 2  # exit status after an error, as typer has it for wrong arguments
EXTRAS = {"torch": "train", **dict.fromkeys(("foxglove", "pyarrow", "rerun", "rosbags"), "recordings")}


def main() -> None:
    """The console script."""
    run(_commands(), callback=_about, invoke_without_command=True)


def _about(
    version: Annotated[bool, typer.Option("--version", help="Print the version, and nothing else.")] = False,
) -> None:
    if version:
        print(f"specshield {__version__}")
        raise typer.Exit


def run(commands: Iterable[Callable[..., None]], **options: Any) -> None:
    """Runs a command line with these commands. Expected errors are shown in one line. After any error the
    exit status is FAILED. A command that worked ends with 1 if what it looked at is not well: a broken rule.

    options: of the `typer.Typer`.
    """
    if sys.version_info < (3, 11):
        _fail(f"This command needs Python 3.11 or later; this is {sys.version.split()[0]}")
    if typer is None:
        _fail(NEEDS_SERVER)
    gc.set_threshold(50_000)  # [objects]: collections took a tenth of a start, and modules are never freed
    kernels = Path(sys.prefix) / "numba-cache"  # the folder of `make`, so that its compiled kernels are used
    if kernels.is_dir():
        os.environ.setdefault("NUMBA_CACHE_DIR", str(kernels))
    app = typer.Typer(
        help="Makes a robot keep the rules that you write, while a model of yours drives it.",
        epilog="In a clone, `make install` adds further commands, such as evaluate.",
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        **options,
    )
    try:
        for command in commands:
            if isinstance(command, typer.Typer):
                app.add_typer(command)
            else:
                app.command(command.__name__.removesuffix("_policy").replace("_", "-"))(command)
        app()
    except Exception as error:
        from specshield.sim.progress import StatusLine

        StatusLine().clear()  # a command may have left a line there
        _fail(_told(error) or traceback.format_exc().rstrip())


def _fail(message: str) -> NoReturn:
    print(message, file=sys.stderr)
    sys.exit(FAILED)


def _told(error: Exception) -> str | None:
    """An expected error in one line; None for any other."""
    if isinstance(error, SpecshieldError):
        return str(error)
    if isinstance(error, OSError):
        if error.filename is not None:  # most likely a file or folder that the caller named
            return f"{error.filename} cannot be used: {error.strerror}"
        if error.errno in (errno.ENOSPC, errno.EDQUOT):  # where a write fails, Python names no file
            return f"what this command writes is not complete: {error.strerror}"
    if isinstance(error, ModuleNotFoundError):
        from specshield.commands.doctor import missing_parts

        missing = (error.name or "").split(".")[0]
        if missing in EXTRAS:
            return f"This command needs {missing}: pip install 'specshield[{EXTRAS[missing]}]'"
        if missing_parts(missing.replace("_", "-")):
            return NEEDS_SERVER
    return None


def _commands() -> Iterator[Callable[..., None]]:
    """The commands of this module and of specshield/commands, and those that other packages register."""
    from specshield.commands.check_drive import check_drive
    from specshield.commands.doctor import doctor
    from specshield.commands.export import export
    from specshield.commands.policy import policy
    from specshield.commands.run import run_policy
    from specshield.commands.train import train
    from specshield.commands.watch import watch
    from specshield.service.access.commands import app as keys

    yield from (serve, demo, policy, run_policy, watch, doctor, train, worker, verify, openapi)
    yield from (export, check_drive, keys)
    for registered in entry_points(group="specshield.commands"):
        yield registered.load()


def serve(
    host: Annotated[str, typer.Option(help="Address to listen on.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(help="Port to listen on.", min=0, max=65535)] = 8000,
    workers: Annotated[int, typer.Option(help="Server processes; they share one store.", min=1)] = 1,
    insecure: Annotated[
        bool, typer.Option("--insecure", help="Serve beyond this machine without asking for a key.")
    ] = False,
) -> None:
    """Run a server. Its settings come from the environment: SPECSHIELD_DATA_DIR, REDIS_URL, ..."""
    import uvicorn

    from specshield.service.heavy.pool import STARTS_WITHIN
    from specshield.service.leaving import GRACE, folder_of_counts, notice_killed
    from specshield.service.storage.embedded import EmbeddedStore
    from specshield.service.storage.marker import check_files
    from specshield.service.watch import logs

    settings = _settings()  # errors in the settings end the command here, with one line
    log_config = logs.config(settings.log_format, settings.log_level)
    logging.config.dictConfig(log_config)  # for what comes before uvicorn, which does the same
    _check_address(host, port)
    embedded = EmbeddedStore(settings.data_dir) if settings.redis_url is None else None
    with ThreadPoolExecutor(1) as beside:  # the store starts during the imports
        joined = beside.submit(embedded.join if embedded is not None else bool)
        if workers == 1:
            gc.disable()  # modules are never freed; `startup.prepare` enables collections again
            from specshield.service.app import create_app
    joined.result()  # raises the error of a store that does not start
    if not insecure and _is_exposed(host, settings):
        os.environ["SPECSHIELD_ASK_FOR_KEY"] = "true"  # for the server's processes, whenever they start
        settings = settings.model_copy(update={"ask_for_key": True})
    with contextlib.suppress(StoreError):  # the store may be away now and come later
        check_files(settings.store_url, settings.files_at, settings.store_timeout)
    options: dict[str, Any] = {
        "host": host,
        "port": port,
        "workers": workers,
        "access_log": False,
        "server_header": False,
        "ws_max_size": settings.max_body_bytes,
        "ws_max_queue": 8,
        "ws_per_message_deflate": False,
        "timeout_graceful_shutdown": GRACE,
        "log_config": log_config,
        "http": "specshield.service.bounds.protocol:BoundedProtocol",
        "ws": "specshield.service.bounds.protocol:BoundedStream",
        "timeout_keep_alive": settings.keep_alive_timeout,
        "timeout_worker_healthcheck": STARTS_WITHIN,
    }
    # After its end, uvicorn raises the signal again that stopped it, which would skip the clean-up below.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    if workers == 1:
        uvicorn.run(create_app(settings, embedded), **options)
        return
    with folder_of_counts() as folder:
        os.environ["PROMETHEUS_MULTIPROC_DIR"] = folder  # before prometheus_client is imported
        notice_killed()
        uvicorn.run("specshield.service.app:create_app", factory=True, **options)
    if embedded is not None:
        embedded.leave()


def worker(
    until_eof: Annotated[bool, typer.Option(help="Stop when standard input ends.", hidden=True)] = False,
    learner: Annotated[bool, typer.Option(help="Only methods that learn.", hidden=True)] = False,
) -> None:
    """Make the policies that a server is asked for, until stopped. Methods that learn need torch.

    Other packages may have jobs too: each entry point of the group specshield.queues has the name of a queue
    of jobs.
    """
    from specshield.service.storage.connect import naming
    from specshield.service.training.worker import serve as work

    settings, others = _settings(), [queue.name for queue in entry_points(group="specshield.queues")]
    with naming(settings):
        work(settings, until_eof, others, learner)


def verify(
    file: Annotated[Path, typer.Argument(help="A record: GET /v1/sessions/{id}/record.", show_default=False)],
    data_dir: Annotated[
        Path | None, typer.Option(help="A server's data folder with its maps and policies.")
    ] = None,
    models_dir: Annotated[
        Path | None, typer.Option(help="A folder of policies; by default those that come with specshield.")
    ] = None,
    maps_dir: Annotated[
        Path | None, typer.Option(help="A folder of maps; by default those that come with specshield.")
    ] = None,
) -> None:
    """Check a session's record: its chain of hashes, and each decision, which is made again and compared.

    The exit status is 0 if nothing differs, 1 if something does, 2 if only the chain could be checked because
    the map or a policy is missing, 3 if the file cannot be read or the result cannot be printed, and 4 if a
    step differs that another version of specshield decided.
    """
    from specshield.service import verify as verifying
    from specshield.service.settings import read_settings

    given = {"data_dir": data_dir, "models_dir": models_dir, "maps_dir": maps_dir}
    try:
        named = {name: folder for name, folder in given.items() if folder is not None}
        for name, folder in named.items():
            if not folder.is_dir():
                option = f"--{name.replace('_', '-')}"
                raise InputError("there is no such folder", path=option, got=str(folder), expected="a folder")
        settings = read_settings().model_copy(update=named)
        status = verifying.verify(file, settings)
        sys.stdout.flush()
    except SpecshieldError as error:
        print(error, file=sys.stderr)
        status = 3
    except OSError as error:  # of standard output: its status would else be 1, as of a record that differs
        print(f"the result cannot be printed: {error.strerror}", file=sys.stderr)
        os._exit(3)  # a further try to print the rest, at the end of the interpreter, would change the status
    raise typer.Exit(status)


def openapi() -> None:
    """Print the API's description (OpenAPI)."""
    from specshield.service.app import create_app
    from specshield.service.settings import read_settings

    print(json.dumps(create_app(read_settings()).routes.openapi(), indent=1, sort_keys=True))


def demo(
    runs: Annotated[int, typer.Option(help="Episodes of each case.", min=1)] = 20,
    seed: Annotated[int, typer.Option(help="Seed of the starts, the model and the draws.", min=0)] = 0,
    out: Annotated[Path, typer.Option(help="Folder for the pictures.")] = Path("out"),
    stay: Annotated[bool, typer.Option("--open", help="Keep the service and its page running.")] = False,
) -> None:
    """Drive a simulated robot in two cases, with and without the shield; print a table and draw pictures."""
    from specshield.sim.demo import run_demo

    raise typer.Exit(run_demo(runs, seed, out, stay))


def _check_address(host: str, port: int) -> None:
    """Raises InputError if no server can listen there."""
    try:
        socket.create_server((host, port), family=socket.AF_INET6 if ":" in host else socket.AF_INET).close()
    except OSError as error:
        reason = str(error.strerror).partition(" (")[0]  # Python adds the address as a tuple
        raise InputError(
            f"the server cannot listen on {host} at port {port}: {reason}",
            expected="an address of this machine and a free port; --port 0 takes any that is free",
        ) from None


def _is_exposed(host: str, settings: Settings) -> bool:
    """Whether other machines reach the server. Raises InputError if anybody on them could use it."""
    from specshield.service.access.commands import on_keys
    from specshield.service.access.site import is_loopback

    exposed = not is_loopback(host)
    if exposed and settings.api_key is None and not on_keys(lambda keys: keys.listed(), settings):
        raise InputError(
            f"whoever reaches {host} reaches this server, and it has no key to ask for",
            path="--host",
            got=host,
            expected="a key, by `specshield keys create` or SPECSHIELD_API_KEY; or an address that only this "
            "machine reaches, such as 127.0.0.1; or --insecure, if a proxy decides who may use the server",
        )
    return exposed


def _settings() -> Settings:
    """The settings, whose data folder is checked. Raises InputError."""
    from specshield.service.library.files import check_writable
    from specshield.service.settings import read_settings

    settings = read_settings()
    check_writable(settings.data_dir, "SPECSHIELD_DATA_DIR")
    return settings


if __name__ == "__main__":
    main()
