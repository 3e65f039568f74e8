"""The `specshield` command. Each command imports what it needs when it runs."""

from __future__ import annotations

import json
import os
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from specshield.errors import SpecshieldError

if TYPE_CHECKING:
    from specshield.service.settings import Settings

try:
    import typer
except ImportError:  # the base install is the client
    typer = None  # type: ignore[assignment]

NEEDS_SERVER = "This command needs the server's parts: pip install 'specshield[server]'"

NEEDS_TORCH = "This command needs torch: pip install 'specshield[train]'"

NEEDS_FIGURES = "This command needs matplotlib: pip install 'specshield[figures]'"


def main() -> None:
    """The console script."""
    if typer is None:
        sys.exit(NEEDS_SERVER)
    try:
        _commands()()
    except SpecshieldError as error:
        sys.exit(f"{error}; expected {error.expected}" if error.expected else str(error))
    except ModuleNotFoundError as error:
        if (error.name or "").split(".")[0] in ("torch",):
            sys.exit(NEEDS_TORCH)
        if (error.name or "").split(".")[0] == "matplotlib":
            sys.exit(NEEDS_FIGURES)
        if (error.name or "").split(".")[0] in (
            "fastapi",
            "fastapi_offline",
            "uvicorn",
            "numba",
            "pydantic",
            "pydantic_settings",
            "redis",
            "rq",
        ):
            sys.exit(NEEDS_SERVER)
        raise


def _commands() -> Any:
    app = typer.Typer(
        help="Keeps robot foundation models inside their operating rules.",
        no_args_is_help=True,
        pretty_exceptions_enable=False,
    )
    for command in (serve, demo, train, evaluate, report, worker, openapi):
        app.command()(command)
    return app


def serve(
    host: Annotated[str, typer.Option(help="Address to listen on.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(help="Port to listen on.", min=0, max=65535)] = 8000,
    workers: Annotated[int, typer.Option(help="Server processes; they share one store.", min=1)] = 1,
) -> None:
    """Serve. Settings come from the environment: SPECSHIELD_DATA_DIR, REDIS_URL, SPECSHIELD_API_KEY, ..."""
    import uvicorn

    from specshield.service.storage.embedded import EmbeddedStore

    settings = _settings()  # what is wrong with them is said here, in one line
    embedded = EmbeddedStore(settings.data_dir) if settings.redis_url is None else None
    if embedded is not None:
        embedded.join()  # and so is why it does not start
    options: dict[str, Any] = {
        "host": host, "port": port, "workers": workers, "access_log": False, "server_header": False,
        "timeout_graceful_shutdown": 5,
    }  # fmt: skip
    if workers == 1:  # uvicorn raises the signal that stopped it again: nothing after it would be cleaned up
        from specshield.service.app import create_app

        uvicorn.run(create_app(settings, embedded), **options)
        return
    with tempfile.TemporaryDirectory(prefix="specshield-metrics-") as folder:
        os.environ["PROMETHEUS_MULTIPROC_DIR"] = folder  # before prometheus_client is imported
        uvicorn.run("specshield.service.app:create_app", factory=True, **options)
    if embedded is not None:
        embedded.leave()


def worker(
    until_eof: Annotated[bool, typer.Option(help="Stop when standard input ends.", hidden=True)] = False,
) -> None:
    """Make the policies and do the runs that are asked for, until stopped; policies that learn need torch."""
    from evaluation.jobs import QUEUE
    from specshield.service.training.worker import serve as work

    work(_settings(), until_eof, [QUEUE])


def openapi() -> None:
    """Print the API's description."""
    from specshield.service.app import create_app
    from specshield.service.settings import read_settings

    print(json.dumps(create_app(read_settings()).openapi(), indent=1, sort_keys=True))


def demo(
    runs: Annotated[int, typer.Option(help="Episodes a case.", min=1)] = 20,
    seed: Annotated[int, typer.Option(help="Decides starts, model and draws.", min=0)] = 0,
    out: Annotated[Path, typer.Option(help="Folder for the pictures.")] = Path("out"),
) -> None:
    """The paper's two cases with and without the shield: a table, and a picture of each."""
    from specshield.sim import commands

    raise typer.Exit(commands.demo(runs, seed, out))


def evaluate(
    case: Annotated[str, typer.Option(help="A case of maps/, as 1 or case1; or house.")],
    runs: Annotated[int, typer.Option(help="Runs, each by every method.", min=1)] = 100,
    seed: Annotated[int, typer.Option(help="Decides starts, model, draws and noise.", min=0)] = 0,
    methods: Annotated[
        str, typer.Option(help="Some of them, as paper,ours; NAME@M/K: margin M metres, slack K steps.")
    ] = "",
    noise: Annotated[
        str, typer.Option(help="none, gaussian, slip, obstacle, shift, collider; or some.")
    ] = "none",
    model: Annotated[str, typer.Option(help="The model that is to be kept to the rule.")] = "learned",
    house: Annotated[str | None, typer.Option(help="A ProcTHOR house, for the case house.")] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder to keep results in and to take them up from.")
    ] = None,
    processes: Annotated[int, typer.Option(help="Processes; 0: one a core.", min=0)] = 0,
    redis: Annotated[
        str | None,
        typer.Option(help="Let the workers of this Redis do the runs instead.", envvar="REDIS_URL"),
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print figures and records as JSON.")] = False,
) -> None:
    """Methods side by side on one case, over any number of runs."""
    from evaluation.experiment import available, experiments
    from specshield.sim import commands

    raise typer.Exit(
        commands.evaluate(
            experiments(case, house, model, noise, seed),
            runs,
            methods.split(",") if methods else available(case),
            out,
            processes or os.cpu_count() or 1,
            redis,
            json,
        )
    )


def report(
    results: Annotated[Path, typer.Argument(help="Folder that evaluate has kept results in.")],
    out: Annotated[Path, typer.Option(help="The page to write; figures go into a folder beside it.")] = Path(
        "docs/results.md"
    ),
) -> None:
    """Write up what evaluate has measured. Needs matplotlib."""
    from evaluation import writeup

    writeup.write_up(results, out)


def train(
    case: Annotated[str, typer.Option(help="A case of maps/, as 1 or case1.")],
    method: Annotated[
        str,
        typer.Option(help="reachability, planner, dqn, or what another package adds."),
    ] = "reachability",
    seed: Annotated[int, typer.Option(help="Decides everything random.", min=0)] = 0,
    updates: Annotated[int | None, typer.Option(help="Updates of the network.", min=1)] = None,
    option: Annotated[list[str] | None, typer.Option(help="A setting, as units=128; repeatable.")] = None,
    out: Annotated[Path | None, typer.Option(help="Folder to write to. [default: in models/]")] = None,
    resume: Annotated[bool, typer.Option(help="Take up a run that was killed.")] = False,
) -> None:
    """Make a policy for a case. Learning shows how far it is and how often the rule is satisfied."""
    from specshield.sim import training

    raise typer.Exit(training.train(case, method, seed, updates, option or [], out, resume))


def _settings() -> Settings:
    """The settings, and a data folder that will do. Raises InputError and StoreError."""
    from specshield.service.library.files import check_writable
    from specshield.service.settings import read_settings
    from specshield.service.storage.embedded import EmbeddedStore

    settings = read_settings()
    check_writable(settings.data_dir, "SPECSHIELD_DATA_DIR")
    if settings.redis_url is None:
        EmbeddedStore(settings.data_dir)  # knows how long its path may be
    return settings


if __name__ == "__main__":
    main()
