"""`specshield export`: writes a session as a file for other tools."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from specshield.errors import InputError, NotFound, SpecshieldError

if TYPE_CHECKING:  # every command imports this module
    from specshield.world.regions import Region


WRITERS = {"mcap": "foxglove", "rrd": "rerun", "parquet": "tables", "csv": "tables"}  # where `write_...` is


def export(
    session: Annotated[
        str, typer.Argument(help="A session's id, or the file of its record.", show_default=False)
    ],
    to: Annotated[
        Literal["mcap", "csv", "parquet", "rrd"], typer.Option(help="mcap opens in Foxglove, rrd in Rerun.")
    ],
    out: Annotated[Path | None, typer.Option(help="The file; by default named by the session's id.")] = None,
    url: Annotated[str, typer.Option(help="The server that has the session.")] = "http://127.0.0.1:8000",
    api_key: Annotated[
        str | None, typer.Option(envvar="SPECSHIELD_API_KEY", help="A key, if the server asks for one.")
    ] = None,
    step_seconds: Annotated[
        float, typer.Option(help="How long a step took, in seconds.", min=1e-3, max=86_400.0)
    ] = 1.0,
) -> None:
    """Write a session as MCAP (Foxglove), CSV, Parquet or for Rerun. Needs the extra `recordings`."""
    from specshield.commands.serving import client_at
    from specshield.recordings.recording import map_of_service, of_record
    from specshield.service.library.maps import Maps
    from specshield.service.sessions import chain
    from specshield.service.settings import read_settings

    file, grid = Path(session), None
    rooms: Mapping[str, Region] = {}
    if file.is_file():
        found = chain.read(file.read_bytes())
        with suppress(NotFound), tempfile.TemporaryDirectory() as folder:
            known = Maps(read_settings().or_empty(folder)).get(found.configs[0].map_id)
            grid, rooms = known.grid, known.rooms
    else:
        with client_at(url, api_key) as client, tempfile.TemporaryDirectory() as folder:
            try:
                client.sessions.get(session).save_record(Path(folder) / "record")
            except SpecshieldError as error:
                told = f"there is no file {session!r}, so it was taken for a session's id: {error.message}"
                raise error.retold(told) from None
            found = chain.read((Path(folder) / "record").read_bytes())
            with suppress(NotFound):  # a map may be deleted once its sessions are closed
                grid, rooms = map_of_service(client, found.configs[0].map_id)
    if grid is None:
        typer.echo("the map is not available: it is left out, and so are the ways ahead", err=True)
    recording = of_record(found, grid, rooms, step_seconds)
    path = out or Path(f"{recording.id}.{to}")
    try:
        getattr(import_module(f"specshield.recordings.{WRITERS[to]}"), f"write_{to}")(recording, path)
    except OSError as error:
        raise InputError(
            f"{path} cannot be written: {error.strerror or error}",
            path="--out",
            got=str(path),
            expected="a file in a folder that exists",
        ) from None
    typer.echo(f"{path}: {len(recording.items)} steps")
