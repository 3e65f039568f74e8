"""`specshield policy`: a policy for one's own map, rule and robot, from files, in one command."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from specshield.errors import InputError, PolicyError

if TYPE_CHECKING:  # every command line reads this module
    from specshield.client import Map, Policy, ShieldClient
    from specshield.sim.progress import StatusLine

URL_HELP = "A server that runs already, with the key SPECSHIELD_API_KEY; else one on SPECSHIELD_DATA_DIR."
LARGEST = 64 << 20  # [bytes] of a file; a server's own limit for a map


def policy(
    map: Annotated[
        str, typer.Option(help="A map's file, a grid's or a house's; else a map's name on the server.")
    ],
    rule: Annotated[
        str, typer.Option(help="What has to be kept, as 'F[0,60] Kitchen and G[0,60] not Hall'.")
    ],
    regions: Annotated[Path | None, typer.Option(help="Places of your own by name, JSON or YAML.")] = None,
    robot: Annotated[str, typer.Option(help="A preset, or your robot's JSON or YAML.")] = "stretch",
    assets: Annotated[Path | None, typer.Option(help="Sizes of a house's furniture, JSON or YAML.")] = None,
    method: Annotated[str, typer.Option(help="How the policy is made.")] = "reachability",
    name: Annotated[str | None, typer.Option(help="What to call the policy.")] = None,
    out: Annotated[Path, typer.Option(help="Folder for the picture.")] = Path("out"),
    url: Annotated[str | None, typer.Option(help=URL_HELP)] = None,
) -> None:
    """Make a policy for a map, a rule and a robot of your own, and draw from where the rule can be kept."""
    from specshield.commands.serving import client_of
    from specshield.service.library.files import check_writable
    from specshield.sim.progress import StatusLine

    check_writable(out, "--out")
    status = StatusLine()
    places = {} if regions is None else _read(regions, "--regions")
    machine = _read(Path(robot), "--robot") if Path(robot).suffix else robot  # else a preset's name
    send = _map(map, assets)
    with client_of(url, status, worker=True) as client:
        world = send(client)
        spec = client.specs.validate(rule, places, map_id=world.id)
        wide, high = world.width * world.resolution, world.height * world.resolution
        size = f"{wide:.1f} x {high:.1f} m at {world.resolution:g} m"
        print(f"map     {world.name or world.id[:12]}: {size}; rooms: {', '.join(world.rooms) or 'none'}")
        print(f"rule    {spec.formula}, over {spec.horizon} steps", flush=True)
        asked = client.policies.create(world.id, rule, places, robot=machine, method=method, name=name)
        status.say(f"making the policy by {method} ...")
        made = client.policies.wait(asked.id, interval=0.2, progress=lambda found: _show(status, found))
        status.clear()
        if made.status == "failed":
            raise PolicyError(f"the policy could not be made: {made.error}")
        called = made.name or made.id
        print(f"policy  {called}")
        for metric, value in made.metrics.items():
            print(f"        {metric}: {value}")
        for warning in made.warnings:
            print(f"        warning: {warning}")
        picture = out / f"{called}.svg"
        picture.write_bytes(client.policies.image(made.id))
    print(f"picture {picture}")
    following = f"specshield run {called}" if url is None else f"a session of policy {called!r} at {url}"
    print(f"next    {following}")
    raise typer.Exit(1 if made.metrics.get("feasible_start") == 0.0 else 0)  # 1: it can keep it from nowhere


def _show(status: StatusLine, found: Policy) -> None:
    from specshield.sim.progress import duration

    left = "" if found.eta_s is None else f", about {duration(found.eta_s)} left"
    status.say(f"{found.status}: {found.error or f'{found.progress:4.0%}{left}'}")


def _map(map: str, assets: Path | None) -> Callable[[ShieldClient], Map]:
    """How the server comes to the map: a file is sent, which is read at once; anything else is the id or the
    name of one that it has.
    """
    path = Path(map)
    content = _read(path, "--map") if path.suffix or path.is_file() else None
    if assets is not None and "rooms" not in (content or {}):
        raise InputError("only a ProcTHOR house has furniture", path="--assets", expected="no --assets")
    if content is None:
        return lambda client: client.maps.get(map)
    if "format" in content:
        return lambda client: client.maps.create(**{str(name): value for name, value in content.items()})
    if "image" in content:
        image = path.parent / Path(str(content["image"])).name
        if not image.is_file():
            told = f"{path} names the image {content['image']!r}, which is not beside it"
            raise InputError(told, path="--map", expected="the map's PGM or PNG beside its YAML")
        return lambda client: client.maps.upload(path, image)
    if "rooms" in content:
        sizes = {} if assets is None else _read(assets, "--assets")
        return lambda client: client.maps.procthor(content, sizes)
    if "info" in content:
        return lambda client: client.maps.occupancy_grid(content["info"], content.get("data", []))
    raise InputError(
        f"{path} is no map of a known form",
        path="--map",
        got=sorted(content)[:8],
        expected="a ROS map's YAML beside its image, a ProcTHOR house, a nav_msgs/OccupancyGrid, or an "
        "object with its `format`",
    )


def _read(path: Path, option: str) -> dict[str, Any]:
    """An object in JSON or YAML. Raises InputError where the file cannot be read or holds none."""
    import yaml

    from specshield.world.checks import shown

    try:
        if path.stat().st_size > LARGEST:
            raise InputError(f"{path} is too large", path=option, expected=f"at most {LARGEST >> 20} MiB")
        text = path.read_text()
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is no text"
        raise InputError(f"{path} cannot be read: {reason}", path=option, got=str(path)) from None
    try:
        document = text.rstrip().removesuffix("\n---")  # with which `ros2 topic echo` ends a message
        loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # the one in C is seven times as fast
        value = json.loads(text) if path.suffix == ".json" else yaml.load(document, loader)
    except (ValueError, yaml.YAMLError, RecursionError) as error:
        raise InputError(f"{path} is neither JSON nor YAML: {str(error)[:200]}", path=option) from None
    if not isinstance(value, dict):
        raise InputError(f"{path} holds no object", path=option, got=shown(value), expected="an object")
    return value
