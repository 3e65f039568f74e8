"""Sessions as files, read back with the libraries of those who will open them."""

from __future__ import annotations

import csv
import json
import math
import struct
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

from specshield.commands.export import WRITERS
from specshield.errors import InputError
from specshield.local import LocalShield
from specshield.recordings import drive
from specshield.recordings.recording import Recording
from specshield.recordings.tables import write_csv, write_parquet
from specshield.robot.dynamics import make_body, step
from specshield.shipped import MODELS
from specshield.world.occupancy import OccupancyGrid
from tests.serving import RunningServer, run_specshield

START = (4.5, 5.0, 0.0)


@pytest.fixture(scope="module")
def shield() -> LocalShield:
    return LocalShield.shipped("case1")


@pytest.fixture(scope="module")
def recording(shield: LocalShield) -> Recording:
    """12 steps, the last without a decision."""
    random, pose = np.random.default_rng(0), START
    session = shield.session(initial_pose=START, uncertainty="none", learn_map=False)
    for _ in range(12):
        decision = session.step(pose, np.where(np.arange(20) == 4, -np.inf, random.normal(size=20)))
        pose = decision.next_poses[decision.execute]
    session.close(pose)
    task, items = shield.task, session.trajectory()
    return Recording(
        session.id, str(task.formula), session.info.actions, task.regions, items, task.grid, task.robot,
        begun=1.7e9, step_seconds=0.5,
    )  # fmt: skip


def test_the_table_has_every_step_and_every_number(recording: Recording, tmp_path: Path) -> None:
    write_csv(recording, tmp_path / "s.csv")
    table = list(csv.DictReader((tmp_path / "s.csv").read_text().splitlines()))
    assert [float(row["x"]) for row in table] == [item.pose[0] for item in recording.items]
    assert float(table[3]["seconds"]) == recording.begun + 1.5
    told = recording.items[5].decision
    assert told is not None
    assert float(table[5]["p_m"]) == told["distribution"][0]
    assert table[5]["mode"] == "shaped"
    assert table[12]["mode"] == ""


def test_parquet_holds_the_same(recording: Recording, tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    write_parquet(recording, tmp_path / "s.parquet")
    table = parquet.read_table(tmp_path / "s.parquet")
    assert table.schema.metadata[b"formula"].startswith(b"F[0,60]")
    assert table["theta"].to_pylist() == [item.pose[2] for item in recording.items]
    assert table["p_m"].to_pylist()[12] is None
    silent = replace(recording, items=[replace(item, decision=None) for item in recording.items])
    write_parquet(silent, tmp_path / "silent.parquet")  # a column that is empty all through keeps its type
    both = parquet.read_table([tmp_path / "s.parquet", tmp_path / "silent.parquet"])
    assert both.num_rows == 2 * table.num_rows
    assert both.schema.types == table.schema.types


def test_mcap_opens_with_the_schemas_of_foxglove(recording: Recording, tmp_path: Path) -> None:
    """Read by the `mcap` library, which checks the file's structure, and decoded by its own schemas."""
    pytest.importorskip("foxglove")
    decoder = pytest.importorskip("mcap_protobuf.decoder")
    from mcap.reader import make_reader

    from specshield.recordings.foxglove import write_mcap

    write_mcap(recording, tmp_path / "s.mcap")
    with open(tmp_path / "s.mcap", "rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[decoder.DecoderFactory()])
        summary = reader.get_summary()
        assert summary is not None
        schemas = {c.topic: summary.schemas[c.schema_id].name for c in summary.channels.values()}
        assert schemas == {
            "/map": "foxglove.Grid",
            "/pose": "foxglove.PoseInFrame",
            "/regions": "foxglove.SceneUpdate",
            "/driven": "foxglove.SceneUpdate",
            "/driven_lately": "foxglove.SceneUpdate",
            "/scene": "foxglove.SceneUpdate",
            "/decision": "specshield.Decision",
        }
        messages = [
            (channel.topic, message.log_time, message.data, schema)
            for schema, channel, message in reader.iter_messages()
        ]
        topics = ["/pose", "/regions", "/driven", "/driven_lately", "/scene", "/map"]
        decoded = [each[3] for each in reader.iter_decoded_messages(topics=topics)]
    told = [json.loads(data) for topic, _, data, _ in messages if topic == "/decision"]
    assert [each["t"] for each in told] == list(range(12))
    times = [at for topic, at, _, _ in messages if topic == "/pose"]
    assert np.diff(times) == pytest.approx(5e8, abs=1e3)
    poses = [each for each in decoded if each.DESCRIPTOR.name == "PoseInFrame"]
    assert [each.pose.position.x for each in poses] == [item.pose[0] for item in recording.items]
    (grid,) = (each for each in decoded if each.DESCRIPTOR.name == "Grid")
    assert recording.grid is not None
    assert np.frombuffer(grid.data, np.uint8).sum() == recording.grid.occupied.sum()
    entities = {e.id: e for each in decoded if each.DESCRIPTOR.name == "SceneUpdate" for e in each.entities}
    regions, ways = {"region/Charger1", "region/Charger2"}, {"driven", "lately", "recent", "continuation"}
    assert regions | ways == set(entities)
    circle = entities["region/Charger1"].lines[0].points
    assert [math.dist((p.x, p.y), (0.9, 5.0)) for p in circle] == pytest.approx([0.6] * len(circle))


def room_of(path: Path) -> int:
    if path.suffix == ".rrd":
        return path.stat().st_size
    from mcap.reader import make_reader

    with open(path, "rb") as file:
        return sum(len(message.data) for _, _, message in make_reader(file).iter_messages())


@pytest.mark.parametrize(("to", "library"), [("mcap", "foxglove"), ("rrd", "rerun")])
def test_a_session_of_thrice_as_many_steps_takes_thrice_the_room(
    recording: Recording, to: str, library: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each step used to hold the whole way driven, and later each hundredth. Poses at random, since files are
    compressed; MCAP's messages are counted before that. Shorter pieces, so that few steps have many.
    """
    pytest.importorskip(library)
    module = import_module(f"specshield.recordings.{library}")
    monkeypatch.setattr(module, "PIECE", 10)
    write = getattr(module, f"write_{to}")
    poses, sizes = np.random.default_rng(0).normal(size=(1500, 3)).tolist(), []
    items = [replace(recording.items[12], t=t, pose=tuple(pose)) for t, pose in enumerate(poses)]
    for steps in (500, 1500):
        write(replace(recording, items=items[:steps]), tmp_path / f"s.{to}")
        sizes.append(room_of(tmp_path / f"s.{to}"))
    assert sizes[1] < 4.0 * sizes[0]


def test_a_viewer_that_jumps_to_a_step_shows_all_of_the_way_driven(
    recording: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It shows the last message of each topic alone."""
    pytest.importorskip("foxglove")
    decoder = pytest.importorskip("mcap_protobuf.decoder")
    from mcap.reader import make_reader

    from specshield.recordings import foxglove

    monkeypatch.setattr(foxglove, "PIECE", 10)
    poses = [(0.1 * t, -0.1 * t, 0.0) for t in range(238)]
    items = [replace(recording.items[12], t=t, pose=pose) for t, pose in enumerate(poses)]
    foxglove.write_mcap(replace(recording, items=items), tmp_path / "s.mcap")
    with open(tmp_path / "s.mcap", "rb") as file:
        reader = make_reader(file, decoder_factories=[decoder.DecoderFactory()])
        last = {
            channel.topic: {entity.id: entity for entity in content.entities}
            for _, channel, _, content in reader.iter_decoded_messages(
                topics=["/regions", "/driven", "/driven_lately", "/scene"]
            )
        }
    assert set(last["/regions"]) == {"region/Charger1", "region/Charger2"}
    lines = last["/driven"]["driven"], last["/driven_lately"]["lately"], last["/scene"]["recent"]
    parts = [[(p.x, p.y) for p in each.lines[0].points] for each in lines]
    assert [len(part) for part in parts] == [201, 31, 8]
    assert parts[0] + parts[1][1:] + parts[2][1:] == [pose[:2] for pose in poses]


def test_the_way_ahead_ends_within_the_rule(recording: Recording) -> None:
    ahead = recording.ahead(3)
    nearest = min(math.dist(pose[:2], centre) for pose in ahead for centre in ((0.9, 5.0), (9.1, 6.6)))
    assert nearest < 0.6
    assert len(recording.ahead(12)) == 1


def test_rerun_writes_a_file(recording: Recording, tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    from specshield.recordings.rerun import write_rrd

    write_rrd(recording, tmp_path / "s.rrd")
    assert (tmp_path / "s.rrd").read_bytes()[:3] == b"RRF"
    assert (tmp_path / "s.rrd").stat().st_size > 10_000


@pytest.mark.parametrize("to", list(WRITERS))
def test_a_disk_that_is_full_is_told(recording: Recording, to: str) -> None:
    """The library of Rerun said nothing of it, or waited for ever; that of Foxglove raised another error."""
    pytest.importorskip({"mcap": "foxglove", "rrd": "rerun"}.get(to, "pyarrow"))
    write = getattr(import_module(f"specshield.recordings.{WRITERS[to]}"), f"write_{to}")
    with pytest.raises(OSError, match="No space left on device"):
        write(recording, Path("/dev/full"))


def bag_of(
    folder: Path, poses: list[tuple[float, float, float]], step_seconds: float, begun: int = 1_000_000_000
) -> Path:
    """A rosbag2 of geometry_msgs/PoseStamped, four times as often as there are steps. begun: [ns]."""
    writer = pytest.importorskip("rosbags.rosbag2")
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    kind = {name.rpartition("/")[2]: store.types[name] for name in store.types}
    with writer.Writer(folder, version=9) as bag:
        connection = bag.add_connection("/robot_pose", "geometry_msgs/msg/PoseStamped", typestore=store)
        for i in range(4 * (len(poses) - 1) + 1):
            x, y, theta = poses[i // 4]
            at = begun + round(i * step_seconds / 4 * 1e9)
            stamp = kind["Time"](sec=at // 10**9, nanosec=at % 10**9)
            turned = kind["Quaternion"](x=0.0, y=0.0, z=math.sin(theta / 2), w=math.cos(theta / 2))
            message = kind["PoseStamped"](
                header=kind["Header"](stamp=stamp, frame_id="map"),
                pose=kind["Pose"](position=kind["Point"](x=x, y=y, z=0.0), orientation=turned),
            )
            bag.write(connection, at, store.serialize_cdr(message, "geometry_msgs/msg/PoseStamped"))
    return folder


def test_a_drive_that_kept_the_rule_and_one_that_lost_it(shield: LocalShield, tmp_path: Path) -> None:
    """The first follows the shield. The second drives on for 12 steps, then stands until it is too late."""
    body, poses = make_body(shield.task.robot, shield.task.grid), [START]
    with shield.session(initial_pose=START, uncertainty="none", learn_map=False) as session:
        while session.spec_status == "pending":
            decision = session.step(poses[-1], None, main_task_done=True)
            poses.append(decision.next_poses[decision.execute])
    read = drive.read_drive(bag_of(tmp_path / "kept", poses, 0.4), 0.4)
    assert read == pytest.approx(np.array(poses), abs=1e-9)
    judged = drive.check_drive(shield, read)
    assert judged.lost is None
    assert judged.verdict.spec_status == "satisfied"

    stays = poses[:3] + [poses[2]] * 70
    lost = drive.check_drive(shield, drive.read_drive(bag_of(tmp_path / "lost", stays, 0.4), 0.4))
    assert lost.verdict.spec_status == "violated"
    assert lost.lost is not None
    reach = 60 - lost.lost  # steps that are left at the first step from which no way was found
    assert 2 < lost.lost < 60
    nearest = min(math.dist(stays[-1][:2], centre) - 0.6 for centre in ((0.9, 5.0), (9.1, 6.6)))
    assert reach * 0.2 < 2.5 * nearest  # not given up long before it was hopeless
    assert (reach - 1) * 0.2 < nearest + 4.0
    assert lost.last == pytest.approx(stays[-1], abs=1e-9)
    assert "until step" in "\n".join(drive.told(shield, lost, 0.4))
    assert step(body, *poses[0], 0)  # the drives are of this robot


def test_a_drive_of_today_is_read_as_one_of_1970(tmp_path: Path) -> None:
    """Some 1.7e18 ns after 1970 a float of seconds is off by more than a tenth of a microsecond."""
    poses = [(0.01 * i, 0.0, 0.0) for i in range(150)]
    read = drive.read_drive(bag_of(tmp_path / "today", poses, 0.1, begun=1_700_000_000_123_456_789), 0.1)
    assert read == pytest.approx(np.array(poses), abs=1e-12)


def test_poses_of_one_topic_from_two_nodes_are_all_read(tmp_path: Path) -> None:
    """In a rosbag1 each node that sends has a connection: a localisation that was started anew has two."""
    writer = pytest.importorskip("rosbags.rosbag1")
    from rosbags.typesys import Stores, get_typestore

    store, kind = get_typestore(Stores.ROS1_NOETIC), "geometry_msgs/msg/PoseStamped"
    made = store.types
    turned = made["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0)
    with writer.Writer(tmp_path / "two.bag") as bag:
        nodes = [bag.add_connection("/pose", kind, typestore=store, callerid=f"/{i}") for i in range(2)]
        for i in range(6):
            message = made[kind](
                header=made["std_msgs/msg/Header"](
                    seq=i, stamp=made["builtin_interfaces/msg/Time"](sec=i, nanosec=0), frame_id="map"
                ),
                pose=made["geometry_msgs/msg/Pose"](
                    position=made["geometry_msgs/msg/Point"](x=float(i), y=0.0, z=0.0), orientation=turned
                ),
            )
            bag.write(nodes[i // 3], i * 10**9, store.serialize_ros1(message, kind))
    assert drive.read_drive(tmp_path / "two.bag", 1.0)[:, 0].tolist() == [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]


def test_a_bag_that_cannot_be_a_drive_is_refused_in_words(tmp_path: Path) -> None:
    content = (bag_of(tmp_path / "whole", [START] * 20, 1.0) / "whole.db3").read_bytes()
    kind = b"geometry_msgs/msg/PoseStamped"
    for name, other, told in (
        ("none", b"", "the bag cannot be read"),
        ("cut", content[:-100], "the bag cannot be read"),  # a page of the table is not whole
        ("text", content.replace(kind, b"\xb9" + kind[1:]), "the bag cannot be read"),
        ("unset", content.replace(struct.pack("<d", 1.0), bytes(8)), "not a unit quaternion"),
        ("nan", content.replace(struct.pack("<d", 1.0), struct.pack("<d", math.nan)), "not a unit quat"),
    ):
        folder = bag_of(tmp_path / name, [START] * 20, 1.0)
        (folder / f"{name}.db3").write_bytes(other)
        with pytest.raises(InputError, match=told):
            drive.read_drive(folder, 1.0)
    set_anew = bag_of(tmp_path / "clock", [START] * 2, 1.7e9)  # from 1970 to today in one step
    with pytest.raises(InputError, match="too far apart in time"):
        drive.read_drive(set_anew, 1e-3)


def test_a_drive_that_kept_the_rule_as_no_known_motion_does_is_no_failure(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """It stands until the robot, as told, is too late, and is then at the charger in one step."""
    typer = pytest.importorskip("typer")
    pytest.importorskip("rosbags")
    from specshield.commands.check_drive import check_drive

    poses = np.array([START] * 59 + [(0.9, 5.0, 0.0)] * 90)
    monkeypatch.setattr(drive, "read_drive", lambda *asked: poses)
    with pytest.raises(typer.Exit) as ended:
        check_drive(Path("bag"), "case1", 1.0)
    told = capsys.readouterr().out
    assert "the rule is kept" in told
    assert "none was found from step" in told
    assert ended.value.exit_code == 0


def test_what_is_taken_of_signals_is_said() -> None:
    """A bag has none of them, so a rule that reads one is judged by what its policy begins with."""
    grid = OccupancyGrid(np.zeros((30, 30), bool), 0.2)
    shield = LocalShield.make(grid, "G[0,3] (x > 1 and battery > 10)", signals={"battery": 90.0})
    judged = drive.check_drive(shield, np.array([(3.0, 3.0, 0.0)] * 4))
    assert judged.verdict.spec_status == "satisfied"
    assert "taken for the whole drive: {'battery': 90.0}" in "\n".join(drive.told(shield, judged, 1.0))


@pytest.mark.parametrize("named", ["none", "", "inside.mcap"])
def test_what_is_no_bag_is_said_to_be_none(named: str, tmp_path: Path) -> None:
    (tmp_path / "inside.mcap").touch()
    with pytest.raises(InputError, match=r"BAG: this is no bag; got '.*'; expected a rosbag2 folder"):
        drive.read_drive(tmp_path / named, 0.4)


def test_a_session_of_a_server_is_exported_by_the_command(server: RunningServer, tmp_path: Path) -> None:
    from specshield.client import ShieldClient

    with ShieldClient(server.url, timeout=30.0) as client:
        session = client.sessions.create(policy_id="case1", initial_pose=START)
        session.step(START, np.zeros(20))
        session.save_record(tmp_path / "record")

    def run(*words: str) -> str:
        done = run_specshield(*words, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        return done.stdout

    assert (
        run("export", session.id, "--to", "csv", "--url", server.url, "--out", "a.csv") == "a.csv: 1 steps\n"
    )
    assert run("export", "record", "--to", "csv", "--out", "b.csv") == "b.csv: 1 steps\n"
    assert (tmp_path / "a.csv").read_text() == (tmp_path / "b.csv").read_text()
    assert not (tmp_path / "data").exists()  # a command that reads leaves no folder behind
    assert run("export", "record", "--to", "mcap") == f"{session.id}.mcap: 1 steps\n"
    LocalShield.make(OccupancyGrid(np.zeros((30, 30), bool), 0.2), "F[0,9] x > 1").save(tmp_path / "room")
    files = [tmp_path / "room" / name for name in ("map.yaml", "map.pgm", "policy.safetensors", "card.json")]
    with ShieldClient(
        server.url, timeout=30.0
    ) as client:  # a session whose map is deleted, once it is closed
        room, made = client.maps.upload(*files[:2]), client.policies.upload(*files[2:])
        with client.sessions.create(policy_id=made.id, initial_pose=(3.0, 3.0, 0.0)) as gone:
            gone.step((3.0, 3.0, 0.0), np.zeros(20))
        client.policies.delete(made.id)
        client.maps.delete(room.id)
    assert run("export", gone.id, "--to", "mcap", "--url", server.url) == f"{gone.id}.mcap: 1 steps\n"
    nowhere = "No such file or directory"
    for to, out, why in (
        ("csv", "nowhere/a", nowhere), ("rrd", "nowhere/a", nowhere), ("rrd", "room", "Is a directory"),
    ):  # fmt: skip
        refused = run_specshield("export", "record", "--to", to, "--out", out, cwd=tmp_path)
        (line,) = refused.stderr.splitlines()
        assert f"{out} cannot be written: {why}" in line
    (tmp_path / "README.md").write_text("# no record\n")
    refused = run_specshield("export", "README.md", "--to", "csv", cwd=tmp_path)
    (line,) = refused.stderr.splitlines()
    assert line.startswith("the file is no record of a session, or not all of one; expected what GET /v1/")
    refused = run_specshield("export", "recrod", "--to", "csv", "--url", server.url, cwd=tmp_path)
    (line,) = refused.stderr.splitlines()
    assert line.startswith("there is no file 'recrod', so it was taken for a session's id: there is no")
    bag_of(tmp_path / "bag", [START] * 70, 1.0)
    words = ["check-drive", "bag", "--policy", "case1", "--step-seconds", "1"]
    refused = run_specshield(*words, cwd=tmp_path)
    assert refused.returncode == 1
    assert "the rule is broken" in refused.stdout
    words[3] = str(MODELS / "case1")  # which has no map beside it
    refused = run_specshield(*words, cwd=tmp_path)
    assert refused.returncode == 2  # 1 would say that the rule is broken
    assert refused.stderr.startswith("--policy: the folder does not say which map")
