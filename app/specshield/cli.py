"""The `specshield` command. Each command imports what it needs when it runs."""

from __future__ import annotations

import contextlib
import gc
import json
import os
import signal
import socket
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

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
    """A command line with these commands. What can be expected to go wrong is told in one line.

    options: of the `typer.Typer`.
    """
    if sys.version_info < (3, 11):
        sys.exit(f"This command needs Python 3.11 or later; this is {sys.version.split()[0]}")
    if typer is None:
        sys.exit(NEEDS_SERVER)
    gc.set_threshold(50_000)  # objects: what is imported stays, and to look at it took a tenth of a start
    kernels = Path(sys.prefix) / "numba-cache"  # where `make` keeps them: what it compiled serves here too
    if kernels.is_dir():
        os.environ.setdefault("NUMBA_CACHE_DIR", str(kernels))
    app = typer.Typer(
        help="Keeps robot foundation models inside their operating rules.",
        epilog="The commands evaluate and report come with evaluation/, from a checkout: make install.",
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
    except SpecshieldError as error:
        from specshield.sim.progress import StatusLine

        StatusLine().clear()  # where a command said what it was doing
        sys.exit(str(error))
    except OSError as error:
        if error.filename is None:  # else it is most likely a file or folder that the caller named
            raise
        sys.exit(f"{error.filename} cannot be used: {error.strerror}")
    except ModuleNotFoundError as error:
        from specshield.commands.doctor import missing_parts

        missing = (error.name or "").split(".")[0]
        if missing in EXTRAS:
            sys.exit(f"This command needs {missing}: pip install 'specshield[{EXTRAS[missing]}]'")
        if missing_parts(missing.replace("_", "-")):
            sys.exit(NEEDS_SERVER)
        raise


def _commands() -> Iterator[Callable[..., None]]:
    """The commands below, and those that other packages register as entry points."""
    from specshield.commands.check_drive import check_drive
    from specshield.commands.doctor import doctor
    from specshield.commands.export import export
    from specshield.commands.policy import policy
    from specshield.commands.run import run_policy
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
    """Serve. Settings come from the environment: SPECSHIELD_DATA_DIR, REDIS_URL, SPECSHIELD_API_KEY, ..."""
    import uvicorn

    from specshield.service.heavy.pool import STARTS_WITHIN
    from specshield.service.leaving import GRACE, notice_killed
    from specshield.service.storage.embedded import EmbeddedStore
    from specshield.service.storage.marker import check_files
    from specshield.service.watch import logs

    settings = _settings()  # what is wrong with them is said here, in one line
    _check_address(host, port)
    embedded = EmbeddedStore(settings.data_dir) if settings.redis_url is None else None
    with ThreadPoolExecutor(1) as beside:  # the store starts while the imports take their time
        joined = beside.submit(embedded.join if embedded is not None else bool)
        if workers == 1:
            gc.disable()  # what is imported stays; `startup.prepare` collects again
            from specshield.service.app import create_app
    joined.result()  # and so is why it does not start
    if not insecure:
        _check_exposure(host, settings)
    with contextlib.suppress(StoreError):  # a store that is away now may come
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
        "log_config": logs.config(settings.log_format, settings.log_level),
        "http": "specshield.service.bounds.protocol:BoundedProtocol",
        "ws": "specshield.service.bounds.protocol:BoundedStream",
        "timeout_keep_alive": settings.keep_alive_timeout,
        "timeout_worker_healthcheck": STARTS_WITHIN,
    }
    # uvicorn raises the signal that stopped it again: nothing after it would be cleaned up.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    if workers == 1:
        uvicorn.run(create_app(settings, embedded), **options)
        return
    with tempfile.TemporaryDirectory(prefix="specshield-metrics-") as folder:
        os.environ["PROMETHEUS_MULTIPROC_DIR"] = folder  # before prometheus_client is imported
        notice_killed()
        uvicorn.run("specshield.service.app:create_app", factory=True, **options)
    if embedded is not None:
        embedded.leave()


def worker(
    until_eof: Annotated[bool, typer.Option(help="Stop when standard input ends.", hidden=True)] = False,
    learner: Annotated[bool, typer.Option(help="Only what takes hours.", hidden=True)] = False,
) -> None:
    """Make the policies that are asked for, until stopped; policies that learn need torch.

    Other packages may have jobs of their own: each entry point of the group specshield.queues is named like
    the queue that its jobs wait in.
    """
    from specshield.service.storage.connect import naming
    from specshield.service.training.worker import serve as work

    settings, others = _settings(), [queue.name for queue in entry_points(group="specshield.queues")]
    with naming(settings):
        work(settings, until_eof, others, learner)


def verify(
    file: Annotated[Path, typer.Argument(help="A record: GET /v1/sessions/{id}/record.", show_default=False)],
    data_dir: Annotated[
        Path | None, typer.Option(help="A server's data folder, for maps and policies that were sent to it.")
    ] = None,
    models_dir: Annotated[
        Path | None, typer.Option(help="Policies, one folder each; by default those shipped.")
    ] = None,
    maps_dir: Annotated[
        Path | None, typer.Option(help="Maps, <name>.yaml beside its image; by default those shipped.")
    ] = None,
) -> None:
    """Check a session's record: its chain of hashes, then every decision, made again to the same bytes.

    The exit status is 0 where all is as it was, 1 where something differs, 2 where map or policy are not at
    hand, so that only the chain was checked, 3 where the file cannot be read, so that nothing was, 4 where a
    step differs that another version decided.
    """
    from specshield.service import verify as verifying
    from specshield.service.settings import read_settings

    given = {"data_dir": data_dir, "models_dir": models_dir, "maps_dir": maps_dir}
    try:
        settings = read_settings().model_copy(update={k: v for k, v in given.items() if v is not None})
        status = verifying.verify(file, settings)
    except SpecshieldError as error:
        print(error, file=sys.stderr)
        status = 3
    raise typer.Exit(status)


def openapi() -> None:
    """Print the API's description."""
    from specshield.service.app import create_app
    from specshield.service.settings import read_settings

    print(json.dumps(create_app(read_settings()).routes.openapi(), indent=1, sort_keys=True))


def demo(
    runs: Annotated[int, typer.Option(help="Episodes a case.", min=1)] = 20,
    seed: Annotated[int, typer.Option(help="Decides starts, model and draws.", min=0)] = 0,
    out: Annotated[Path, typer.Option(help="Folder for the pictures.")] = Path("out"),
    stay: Annotated[bool, typer.Option("--open", help="Leave the service up, and its page.")] = False,
) -> None:
    """The paper's two cases with and without the shield: a table, and a picture of each."""
    from specshield.sim.demo import run_demo

    raise typer.Exit(run_demo(runs, seed, out, stay))


def train(
    case: Annotated[str, typer.Option(help="A case of maps/, as 1 or case1.")],
    method: Annotated[
        str, typer.Option(help="reachability, planner, dqn, or what another package adds.")
    ] = "reachability",
    seed: Annotated[int, typer.Option(help="Decides everything random.", min=0)] = 0,
    updates: Annotated[int | None, typer.Option(help="Updates of the network.", min=1)] = None,
    option: Annotated[list[str] | None, typer.Option(help="A setting, as units=128; repeatable.")] = None,
    out: Annotated[Path | None, typer.Option(help="By default a folder of models/ that has none.")] = None,
    resume: Annotated[bool, typer.Option(help="Take up a run that was killed.")] = False,
) -> None:
    """Make a policy for a case. Learning shows how far it is and how often the rule is satisfied."""
    from specshield.sim import training

    training.train(case, method, seed, updates, option or [], out, resume)


def _check_address(host: str, port: int) -> None:
    """Raises InputError where no server can listen there."""
    try:
        socket.create_server((host, port), family=socket.AF_INET6 if ":" in host else socket.AF_INET).close()
    except OSError as error:
        reason = str(error.strerror).partition(" (")[0]  # which Python follows with the address as a tuple
        raise InputError(
            f"the server cannot listen on {host} at port {port}: {reason}",
            expected="an address of this machine and a free port; --port 0 takes any that is free",
        ) from None


def _check_exposure(host: str, settings: Settings) -> None:
    """Raises InputError where anybody on the network could use the server."""
    from specshield.service.access.commands import on_keys
    from specshield.service.access.site import is_loopback

    exposed = not is_loopback(host) and settings.api_key is None
    if exposed and not on_keys(lambda keys: keys.listed(), settings):
        raise InputError(
            f"whoever reaches {host} could use this server, since it asks for no key",
            path="--host",
            got=host,
            expected="a key, by `specshield keys create` or SPECSHIELD_API_KEY; or an address that only this "
            "machine reaches, as 127.0.0.1; or --insecure, where something in front decides who may",
        )


def _settings() -> Settings:
    """The settings, and a data folder that will do. Raises InputError."""
    from specshield.service.library.files import check_writable
    from specshield.service.settings import read_settings

    settings = read_settings()
    check_writable(settings.data_dir, "SPECSHIELD_DATA_DIR")
    return settings


if __name__ == "__main__":
    main()
