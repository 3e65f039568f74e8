"""The command without its parts, and with settings that cannot be."""

import re
import socket
import subprocess
import sys

import httpx
import pytest

from tests.serving import HUNG, free_port, run_specshield, serving, wait_for

WITHOUT = """
import sys
class Without:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {parts}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
sys.meta_path.insert(0, Without())
sys.argv = ["specshield", *{arguments}]
from specshield.cli import main
main()
"""


@pytest.mark.parametrize(
    ("parts", "arguments", "told"),
    [
        (["typer"], ["serve"], "specshield[server]"),
        (["fastapi"], ["openapi"], "specshield[server]"),
        (["uvicorn"], ["serve"], "specshield[server]"),
    ],
)
def test_what_is_not_installed_is_said(parts, arguments, told):
    code = WITHOUT.format(parts=parts, arguments=arguments)
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=HUNG)
    assert run.returncode == 2
    assert told in run.stderr
    assert "Traceback" not in run.stderr


@pytest.mark.parametrize(
    ("command", "environment", "told", "expected"),
    [
        (
            "serve",
            {"SPECSHIELD_MAX_SESSIONS": "abc"},
            "SPECSHIELD_MAX_SESSIONS is not valid: 'abc'",
            "whole number",
        ),
        (
            "serve",
            {"SPECSHIELD_STORE_TIMEOUT": "0"},
            "SPECSHIELD_STORE_TIMEOUT is not valid: '0'",
            "greater than 0",
        ),
        (
            "serve",
            {"SPECSHIELD_STORE_TIMEOUT": "inf"},
            "SPECSHIELD_STORE_TIMEOUT is not valid: 'inf'",
            "less than or equal to 86400",
        ),
        (
            "serve",
            {"SPECSHIELD_DATA_URL": "ftp://robot:secret@127.0.0.1:1/files"},
            "files at 'ftp://127.0.0.1:1/files' cannot be used",
            "a folder, or a URL such as",
        ),
        (
            "serve",
            {"SPECSHIELD_DATA_URL": "memory://files"},
            "SPECSHIELD_DATA_URL: files in memory are seen by one process alone",
            "a folder, or a URL that every process reaches",
        ),
        (
            "serve",
            {"SPECSHIELD_STORE_REPLICAS": "1"},
            "SPECSHIELD_STORE_REPLICAS is not valid: '1'",
            "0 unless REDIS_URL is set",
        ),
        (
            "serve",
            {"SPECSHIELD_SESSION_TTL": f"1{18 * '0'}"},
            "SPECSHIELD_SESSION_TTL is not valid",
            "315360000",
        ),
        (
            "serve",
            {"SPECSHIELD_HEAVY_MEMORY": f"1{18 * '0'}"},
            "SPECSHIELD_HEAVY_MEMORY is not valid",
            "less ",
        ),
        ("worker", {"REDIS_URL": "foo"}, "REDIS_URL is not valid", "redis://127.0.0.1:6379/0"),
        *(
            ("serve", {"REDIS_URL": url}, "REDIS_URL is not valid", "redis://127.0.0.1:6379/0")
            for url in ("redis:/127.0.0.1:6379/0", "redis://h/0?protocol=9", "redis://h/prod")
        ),
        (
            "serve",
            {"REDIS_URL": "redis://h/0?ssl_cacerts=/etc/ca.pem"},
            "REDIS_URL is not valid",
            "redis://127.0.0.1:6379/0",
        ),
        (
            "serve",
            {"SPECSHIELD_API_KEYS": "secret"},
            "SPECSHIELD_API_KEYS is not a setting",
            "SPECSHIELD_API_KEY,",
        ),
        (
            "serve",
            {"SPECSHIELD_REDIS_URL": "redis://:secret@host:port"},
            "REDIS_URL is not valid",
            "redis://127.0.0.1:6379/0",
        ),
        (
            "serve",
            {"REDIS_URL": "redis://:secret@host:port"},
            "REDIS_URL is not valid",
            "redis://127.0.0.1:6379/0",
        ),
        (
            "worker",
            {"SPECSHIELD_DATA_DIR": "{folder}/file"},
            "SPECSHIELD_DATA_DIR cannot be used",
            "a folder to write",
        ),
        (
            "serve",
            {"SPECSHIELD_DATA_DIR": "{folder}/file/in"},
            "SPECSHIELD_DATA_DIR cannot be used",
            "a folder to wr",
        ),
        (
            "serve",
            {"SPECSHIELD_MODELS_DIR": "{folder}/none"},
            "SPECSHIELD_MODELS_DIR is not valid: '",
            "a folder that exists",
        ),
        (
            "worker",
            {"SPECSHIELD_MAPS_DIR": "{folder}/file"},
            "SPECSHIELD_MAPS_DIR is not valid: '",
            "a folder that exists",
        ),
        (
            "worker",
            {"SPECSHIELD_DATA_DIR": " data"},
            "SPECSHIELD_DATA_DIR is not valid: ' data'",
            "neither begins nor ends with a space",
        ),
        ("serve", {"SPECSHIELD_WORKER": "yep"}, "SPECSHIELD_WORKER is not valid: 'yep'", "true or false"),
        (
            "serve",
            {"SPECSHIELD_DATA_DIR": "{folder}/" + "x" * 90},
            "data folder's path is too long",
            "87 bytes",
        ),
    ],
)
def test_settings_that_cannot_be_are_said_in_one_line(tmp_path, command, environment, told, expected):
    (tmp_path / "file").touch()
    given = {name: value.replace("{folder}", str(tmp_path)) for name, value in environment.items()}
    run = run_specshield(command, cwd=tmp_path, **given)
    assert run.returncode == 2
    (line,) = run.stderr.splitlines()
    assert told in line
    assert expected in line.partition("; expected ")[2]
    assert "secret" not in line


@pytest.mark.parametrize(
    ("url", "cause"),
    [
        ("redis://127.0.0.1:{port}", r"ConnectionError \(.*refused\.\)"),
        ("redis+sentinel://127.0.0.1:{port}/shield", r"MasterNotFoundError \(No master found for 'shield'\)"),
    ],
)
def test_a_worker_whose_store_is_away_says_so_without_a_traceback(tmp_path, url, cause):
    run = run_specshield("worker", cwd=tmp_path, REDIS_URL=url.format(port=free_port()))
    assert run.returncode == 2
    told = run.stderr.splitlines()[-1]
    assert re.fullmatch(f"REDIS_URL: the store cannot be reached: {cause}", told)
    assert "Traceback" not in run.stderr


def test_a_server_whose_store_is_away_tells_its_log_why_and_callers_only_that_it_is(tmp_path):
    away = f"redis://robot:secret@127.0.0.1:{free_port()}"
    with serving(tmp_path, ready=False, REDIS_URL=away) as server:
        server.log.touch()
        for line in ("Uvicorn running", "not ready yet"):
            wait_for(lambda line=line: line in server.log.read_text())
        told = httpx.get(f"{server.url}/readyz").text
    log = server.log.read_text()
    assert re.search(r"not ready yet, .* cannot be reached: ConnectionError \(.*127.0.0.1.* refused\.\)", log)
    assert "cannot be reached" in told
    assert "127.0.0.1" not in told
    assert "secret" not in log + told


@pytest.mark.parametrize("more", [[], ["--workers", "2"]])
def test_why_the_store_does_not_start_is_said_in_one_line(tmp_path, more):
    folder = tmp_path / "store" / "appendonlydir"
    folder.mkdir(parents=True)
    (folder / "appendonly.aof.manifest").write_text("not a manifest\n")
    run = run_specshield("serve", "--port", "0", *more, SPECSHIELD_DATA_DIR=str(tmp_path))
    assert run.returncode == 2
    (line,) = run.stderr.splitlines()
    assert line.startswith("the embedded store does not start: Invalid AOF manifest file format; see ")
    assert line.endswith("store.log")


def test_a_port_that_is_taken_is_said_in_one_line(tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        run = run_specshield("serve", "--port", port, SPECSHIELD_DATA_DIR=str(tmp_path))
    assert run.returncode == 2
    (line,) = run.stderr.splitlines()
    assert line.startswith(f"the server cannot listen on 127.0.0.1 at port {port}: Address already in use;")
    assert "--port 0" in line
