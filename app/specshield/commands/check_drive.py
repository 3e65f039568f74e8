"""`specshield check-drive`: judges a recorded drive by a rule."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from specshield.errors import SpecshieldError


def check_drive(
    bag: Annotated[Path, typer.Argument(help="A rosbag2: its folder.", show_default=False)],
    policy: Annotated[
        str, typer.Option(help="A policy that came with specshield, or a folder of LocalShield.save.")
    ],
    step_seconds: Annotated[
        float,
        typer.Option(help="How long a step is, in seconds.", min=1e-3, max=86_400.0, show_default=False),
    ],
    topic: Annotated[
        str | None, typer.Option(help="Topic of poses in the map's frame. By default the only one.")
    ] = None,
) -> None:
    """Say whether a drive in a rosbag2 kept the rule, and from which step on no way to keep it was found.

    The exit status is 1 if the rule is broken, or open while no way to keep it was found, 2
    after an error, such as a bag that cannot be read; else 0.
    """
    from specshield.local import LocalShield
    from specshield.recordings import drive

    folder, driven = Path(policy), drive.read_drive(bag, step_seconds, topic)
    try:
        shield = LocalShield.load(folder) if (folder / "card.json").is_file() else LocalShield.shipped(policy)
    except SpecshieldError as error:
        error.path = "--policy"
        raise
    judged = drive.check_drive(shield, driven)
    for line in drive.told(shield, judged, step_seconds):
        typer.echo(line)
    raise typer.Exit(1 if judged.lost is not None and judged.verdict.spec_status != "satisfied" else 0)
