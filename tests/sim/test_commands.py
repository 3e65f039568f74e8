"""The commands as a user runs them."""

import json
import os
import signal

import httpx
import pytest

from specshield.commands.train import _alone_in
from specshield.policy.methods import load_policy
from specshield.sim.cases import load_case
from tests.serving import HUNG, ROBOTS, Forked, children, run_specshield, runs, wait_for


def specshield(*arguments, code=0, **environment):
    done = run_specshield(*arguments, **environment)
    assert done.returncode == code, done.stderr
    return done


def test_demo_prints_the_table_and_draws_each_case(tmp_path):
    """Also where the environment names a proxy, which leads to no server of this machine."""
    asked = ("demo", "--runs", "1", "--seed", "4", "--out", str(tmp_path))
    done = specshield(*asked, http_proxy="http://127.0.0.1:9", **{ROBOTS: "yes"})
    assert "1 episodes a case, seed 4" in done.stdout
    assert "rule satisfied" in done.stdout
    assert done.stdout.count("1 of 1") >= 4
    assert sorted(path.name for path in tmp_path.iterdir()) == ["case1.svg", "case2.svg"]
    assert "starting the service" in done.stderr
    assert "page of both" not in done.stdout  # the service has ended


def begun(folder, *arguments, **environment):
    """The command, in a session of its own, and the files that it writes to."""
    out, err = folder / "stdout", folder / "stderr"
    out.touch()
    err.touch()
    return Forked([*arguments], {**os.environ, **environment}, stdout=out, stderr=err, cwd=folder), out, err


def test_demo_leaves_its_page_up_when_asked(tmp_path):
    asked = ("demo", "--runs", "1", "--seed", "4", "--open", "--out", str(tmp_path))
    running, told, _ = begun(tmp_path, *asked, **{ROBOTS: "yes"})
    try:
        wait_for(lambda: "Ctrl-C ends both" in told.read_text() or running.poll() is not None)
        page = next(line for line in told.read_text().splitlines() if line.startswith("page of both"))
        url, _, ids = page.split(": ", 1)[1].partition("/#/floor?sessions=")
        told = [
            httpx.get(f"{url}/v1/sessions/{id}/trajectory", timeout=None, verify=False).json()["items"]
            for id in ids.split(",")
        ]
        assert all(told)
        assert told[0][0]["pose"] == told[1][0]["pose"], "from the same start, with the shield and without"
        assert told[0][0]["decision"] is not None
        assert told[1][0]["decision"] is None
        assert "specshield" in httpx.get(url, timeout=None, verify=False).text
        running.send_signal(signal.SIGINT)
        assert running.wait(HUNG) == 0
    finally:
        running.kill()


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
@pytest.mark.parametrize("command", ["demo", "evaluate"])
def test_a_command_that_is_stopped_leaves_nothing_running(command, how, tmp_path):
    arguments = {
        "demo": ["demo", "--out", str(tmp_path)],
        "evaluate": ["evaluate", "--case", "case1", "--methods", "ours", "--processes", "2"],
    }[command]
    running, _, told = begun(tmp_path, *arguments, "--runs", "500")
    try:
        if command == "demo":
            wait_for(lambda: len(children(running.pid)) >= 3)  # the server, a robot, and the tracker as below
            started = [each for child in children(running.pid) for each in (child, *children(child))]
            assert len(started) > 4  # the store's keeper and a process for heavy work, too
        else:
            wait_for(lambda: len(children(running.pid)) >= 3)  # two workers and what tracks their semaphores
            started = children(running.pid)
        if how == signal.SIGINT:  # a terminal sends it to all
            os.killpg(running.pid, how)
        else:
            running.send_signal(how)
        assert running.wait(HUNG) != 0
        wait_for(lambda: not any(map(runs, started)))
        # A process that is just starting when its parent is killed cannot but say so.
        assert how == signal.SIGKILL or "Traceback" not in told.read_text()
    finally:
        running.kill()


def test_train_resumes_after_a_kill_and_writes_a_policy_that_serves(tmp_path):
    pytest.importorskip("torch")
    case, out = load_case("case1"), tmp_path / "model"
    arguments = ["train", "--case", "case1", "--method", "dqn", "--seed", "3", "--updates", "400"]
    for option in ("units=8", "evaluate_every=100", "evaluation_starts=50"):
        arguments += ["--option", option]
    arguments += ["--out", str(out)]
    command, *_ = begun(tmp_path, *arguments)
    wait_for((out / "checkpoint" / "state.safetensors").exists)
    command.kill()
    command.wait()
    assert not (out / "card.json").exists()
    done = specshield(*arguments, "--resume")
    assert "satisfies alone from" in done.stdout
    assert sorted(path.name for path in out.iterdir()) == ["card.json", "policy.safetensors"]
    card = json.loads((out / "card.json").read_text())
    assert card["options"]["units"] == 8
    assert card["spec"] == case.spec
    load_policy((out / "policy.safetensors").read_bytes(), card, case.task)


def test_two_that_train_in_one_folder_do_not_remove_each_others_checkpoint(tmp_path):
    kept = tmp_path / "checkpoint" / "kept"
    kept.parent.mkdir()
    kept.touch()
    with _alone_in(tmp_path):
        done = specshield("train", "--case", "case1", "--out", str(tmp_path), code=2)
    assert "another `specshield train` makes a policy in" in done.stderr
    assert kept.exists()


def test_train_computes_a_policy_too(tmp_path):
    done = specshield("train", "--case", "case1", "--method", "reachability", "--out", str(tmp_path))
    assert "feasible from" in done.stdout
    card = json.loads((tmp_path / "card.json").read_text())
    assert card["metrics"]["feasible_start"] > 0.95
    load_policy((tmp_path / "policy.safetensors").read_bytes(), card, load_case("case1").task)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["train", "--case", "case9"], "one of case1, case2"),
        (["train", "--case", "case1", "--method", "dqn", "--option", "units=9000"], "from 4 to 128"),
        (["train", "--case", "case1", "--method", "magic"], "one of dqn, planner, reachability"),
    ],
)
def test_a_mistake_is_told_in_a_line(arguments, said):
    done = specshield(*arguments, code=2)
    assert said in done.stderr
    assert "Traceback" not in done.stderr
