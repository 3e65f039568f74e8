"""`specshield policy`: makes a policy for your own map, rule and robot from files."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from specshield.errors import InputError, MapError, PolicyError

if TYPE_CHECKING:  # every command imports this module
    from specshield.client import Map, Policy, ShieldClient
    from specshield.sim.progress import StatusLine

URL_HELP = "A running server (key: SPECSHIELD_API_KEY). By default one is started on SPECSHIELD_DATA_DIR."
LARGEST = 64 << 20  # [bytes] of a file: a server's limit for a map


def policy(
    map: Annotated[
        str, typer.Option(help="The file of a map, a grid or a house, or a map's name on the server.")
    ],
    rule: Annotated[str, typer.Option(help="The rule, such as 'F[0,60] Kitchen and G[0,60] not Hall'.")],
    regions: Annotated[Path | None, typer.Option(help="JSON or YAML file of your own places.")] = None,
    robot: Annotated[str, typer.Option(help="A preset, or a JSON or YAML file.")] = "stretch",
    assets: Annotated[Path | None, typer.Option(help="JSON or YAML file of furniture sizes.")] = None,
    method: Annotated[
        str, typer.Option(help="reachability, planner, dqn, or one of another package.")
    ] = "reachability",
    name: Annotated[str | None, typer.Option(help="A name for the policy.")] = None,
    out: Annotated[Path, typer.Option(help="Folder for the picture.")] = Path("out"),
    url: Annotated[str | None, typer.Option(help=URL_HELP)] = None,
) -> None:
    """Make a policy for your own map, rule and robot, and draw the starts from which it can keep the rule."""
    from specshield.commands.serving import client_of
    from specshield.service.library.files import check_writable
    from specshield.sim.progress import StatusLine

    check_writable(out, "--out")
    logging.getLogger("specshield").addHandler(logging.NullHandler())  # what the client would log is printed
    status = StatusLine()
    places = {} if regions is None else _read(regions, "--regions")
    machine = _read(Path(robot), "--robot") if Path(robot).suffix else robot  # a file, or a preset's name
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
    if made.metrics.get("feasible_start") == 0.0:
        print("next    another rule or map: from no start that was tried can this rule be kept")
        raise typer.Exit(1)
    following = f"specshield run {called}" if url is None else f"a session of policy {called!r} at {url}"
    print(f"next    {following}")


def _show(status: StatusLine, found: Policy) -> None:
    from specshield.sim.progress import duration

    left = "" if found.eta_s is None else f", about {duration(found.eta_s)} left"
    state = "being made" if found.status == "training" else found.status  # most methods learn nothing
    status.say(f"{state}: {found.error or f'{found.progress:4.0%}{left}'}")


def _map(map: str, assets: Path | None) -> Callable[[ShieldClient], Map]:
    """A function that gets the map from the server: it sends a file, which is read now, or finds the server's
    map of this id or name.
    """
    path = Path(map)
    named = "/" not in map and path.suffix.lower() not in (".json", ".yaml", ".yml") and not path.is_file()
    content = None if named else _read(path, "--map")
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
    if isinstance(content.get("rooms"), list):
        sizes = {} if assets is None else _read(assets, "--assets")
        return lambda client: _sent_house(client, content, sizes)
    if "info" in content and "data" in content:
        return lambda client: client.maps.occupancy_grid(content["info"], content["data"])
    raise InputError(
        f"{path} is no map of a known form",
        path="--map",
        got=sorted(content)[:8],
        expected="a ROS map's YAML beside its image, a ProcTHOR house, a nav_msgs/OccupancyGrid with "
        "`info` and `data`, or an object with its `format`",
    )


def _sent_house(client: ShieldClient, house: Any, sizes: dict[str, Any]) -> Map:
    try:
        return client.maps.procthor(house, sizes)
    except MapError as error:
        if "asset_sizes" in (error.expected or ""):
            error.expected = "the sizes of all furniture, in the file of --assets"
        raise


def _read(path: Path, option: str) -> dict[str, Any]:
    """The object in a JSON or YAML file. Raises InputError if the file cannot be read or has none."""
    import yaml

    from specshield.world.checks import shown

    try:
        if path.stat().st_size > LARGEST:
            raise InputError(f"{path} is too large", path=option, expected=f"at most {LARGEST >> 20} MiB")
        text = path.read_text()
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is no text"
        expected = "a JSON or YAML file"
        if option == "--map":
            expected += "; of a map drawn as an image, the YAML beside it; or the name of a map on the server"
        raise InputError(f"{path} cannot be read: {reason}", path=option, expected=expected) from None
    try:
        document = text.rstrip().removesuffix("\n---")  # `ros2 topic echo` ends a message with that
        loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # the loader in C is seven times as fast
        value = json.loads(text) if path.suffix == ".json" else yaml.load(document, loader)
    except (ValueError, yaml.YAMLError, RecursionError) as error:
        raise InputError(f"{path} is neither JSON nor YAML: {str(error)[:200]}", path=option) from None
    if not isinstance(value, dict):
        raise InputError(f"{path} holds no object", path=option, got=shown(value), expected="an object")
    return value
