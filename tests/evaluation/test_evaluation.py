"""Campaigns: the same records whichever process made them, and whether at once or in two goes."""

import json
import math
import os
import shutil
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from redis import Redis
from rq import Queue, Worker
from rq.serializers import JSONSerializer

from evaluation import calibration, campaigns, experiment, results, shipped
from evaluation.evaluation import evaluate, read
from evaluation.experiment import Experiment
from evaluation.houses import RULE, load_house_case, located
from evaluation.jobs import QUEUE
from evaluation.runs import run
from specshield.errors import InputError, NotFound, SpecshieldError, StoreError
from specshield.service.storage.embedded import EmbeddedStore
from specshield.sim import cases
from specshield.sim.cases import load_case
from specshield.world.regions import signed_distance
from tests.oracles.judge import margin
from tests.serving import HUNG, Forked, children, command_line, wait_for
from tests.stores import cluster, needs_redis

EXPERIMENT = Experiment("case1", noise="gaussian", seed=5)
METHODS = ["unmodified", "ours@0.03/8"]
RUNS = 3


def same(records):
    """What has to be equal: all but the times."""
    return [{name: v for name, v in r.to_json().items() if name != "decision_ms"} for r in records]


@pytest.fixture(scope="module")
def serial():
    return evaluate(EXPERIMENT, RUNS, METHODS)


@pytest.fixture(scope="module")
def first(tmp_path_factory):
    """A folder with the first run of each method."""
    folder = tmp_path_factory.mktemp("first")
    evaluate(EXPERIMENT, 1, METHODS, folder)
    return folder


def test_runs_share_all_but_the_method(serial):
    assert [(r.run, r.method) for r in serial] == [(i, name) for i in range(RUNS) for name in METHODS]
    for plain, shielded in zip(serial[::2], serial[1::2], strict=True):
        assert (plain.seed, plain.start, plain.refused) == (shielded.seed, shielded.start, shielded.refused)
        assert (plain.satisfied, shielded.satisfied) == (False, True)
        assert plain.modes == {"prior": plain.steps + 1}
        assert plain.kl == pytest.approx(0.0, abs=1e-9)
    assert max(record.kl for record in serial[1::2]) > 1.0
    assert len({record.seed for record in serial}) == RUNS


def test_a_record_says_what_its_poses_say(serial):
    case = load_case("case1")
    for record in serial:
        still = [record.poses[-1]] * (case.task.horizon + 1 - len(record.poses))
        assert record.rho == pytest.approx(margin(case.spec, record.poses + still), abs=1e-3)
        assert len(record.poses) == record.steps + 1
        assert record.poses[0] == pytest.approx(record.start, abs=1e-4)
        assert bool(record.broken) is not record.satisfied
        assert len(record.mass) == len(record.certified) == sum(record.modes.values())
        assert 0.01 < record.residual < 0.1
        assert record.main_done
        x, y, _ = record.poses[record.ended_at]
        assert np.hypot(x - case.target[0], y - case.target[1]) < 1.0


def test_processes_and_a_second_go_make_the_same_records(serial, tmp_path):
    first = evaluate(EXPERIMENT, 1, METHODS[:1], tmp_path)
    assert same(first) == same(serial[:1])
    path = tmp_path / "runs.jsonl"
    path.write_bytes(path.read_bytes() + b'{"run": 1, "method"')  # killed while it wrote
    assert same(read(tmp_path)) == same(first)
    seen = []
    again = evaluate(EXPERIMENT, RUNS, METHODS, tmp_path, processes=2, on_progress=seen.append)
    assert same(again) == same(serial)
    assert again[0].decision_ms == first[0].decision_ms  # kept, not made again
    assert seen == [0, 1, 2, 3]
    assert len(path.read_text().splitlines()) == RUNS * len(METHODS)
    assert same(evaluate(EXPERIMENT, 2, METHODS, tmp_path)) == same(serial[:4])
    with pytest.raises(InputError):
        evaluate(Experiment("case1", seed=6), 1, METHODS, tmp_path)


def test_a_method_named_twice_is_run_once_and_counts_once(serial, tmp_path):
    again = evaluate(EXPERIMENT, RUNS, ["unmodified", "ours@0.03/8", "unmodified"], tmp_path)
    assert same(again) == same(serial)
    path = tmp_path / "runs.jsonl"
    assert len(path.read_text().splitlines()) == RUNS * len(METHODS)
    path.write_text(path.read_text() * 2)
    assert same(read(tmp_path)) == same(serial)
    assert [one["runs"] for one in results.write(tmp_path)["methods"]] == [RUNS, RUNS]


def test_a_folder_of_other_records_is_refused_before_anything_is_done(tmp_path):
    """The margin is not calibrated, nor is the first experiment run, where the second cannot be kept."""
    asked = [Experiment("case1", noise=noise, seed=5) for noise in ("none", "gaussian")]
    kept = tmp_path / "case1" / "gaussian"
    kept.mkdir(parents=True)
    (kept / "experiment.json").write_text(json.dumps(replace(asked[1], seed=6).to_json()))
    with pytest.raises(InputError, match="another experiment"):
        campaigns.evaluate(asked, 1, ["ours@conformal/4"], tmp_path, 1, None, False)
    assert [path.name for path in tmp_path.rglob("*.json*")] == ["experiment.json"]


@pytest.mark.parametrize("damage", [b"x", b"[]", b'{"run": 0}', b"\xff", b"\x00"])
def test_a_damaged_run_is_told_by_its_line_and_made_again_once_that_is_deleted(
    serial, first, tmp_path, damage
):
    shutil.copytree(first, tmp_path, dirs_exist_ok=True)
    path = tmp_path / "runs.jsonl"
    whole = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(damage + b"\n" + whole[1])
    for reading in (lambda: evaluate(EXPERIMENT, 1, METHODS, tmp_path), lambda: read(tmp_path)):
        with pytest.raises(InputError, match=r"^out: line 1 of .*runs\.jsonl is not a run of this version"):
            reading()
    path.write_bytes(whole[1])
    assert same(evaluate(EXPERIMENT, 1, METHODS, tmp_path)) == same(serial[:2])


def test_runs_of_which_nothing_says_the_experiment_are_not_taken_for_this_one(first, tmp_path):
    shutil.copytree(first, tmp_path, dirs_exist_ok=True)
    (tmp_path / "experiment.json").unlink()
    with pytest.raises(InputError, match=r"has runs, and no experiment\.json"):
        evaluate(Experiment("case1", seed=6), 1, METHODS[:1], tmp_path)


@pytest.mark.parametrize("description", ['{"case": "ca', "[]", "{}", '{"case": "case1", "sead": 0}'])
def test_a_folder_whose_description_is_broken_is_told_in_a_line(tmp_path, description):
    kept = tmp_path / "case1" / "none"
    kept.mkdir(parents=True)
    (kept / "experiment.json").write_text(description)
    with pytest.raises(InputError, match=r"experiment\.json is no description of an experiment"):
        campaigns.evaluate([Experiment("case1")], 1, ["ours"], tmp_path, 1, None, False)


@pytest.mark.parametrize("name", ["magic", "magic@conformal", "hcd@conformal/4", "ours@much"])
def test_a_method_that_is_not_is_told_before_anything_is_done(tmp_path, name):
    with pytest.raises((InputError, NotFound)) as caught:
        campaigns.evaluate([Experiment("case1")], 1, ["ours@conformal", name], tmp_path, 1, None, False)
    assert caught.value.path == "methods"
    assert not list(tmp_path.iterdir())


def test_records_are_not_mixed_with_those_of_another_map_policy_or_model(tmp_path, monkeypatch):
    """What is there is copied, and changed as little as can be."""
    out, asked = tmp_path / "out", Experiment("case1", seed=8)
    kept = evaluate(asked, 1, ["unmodified"], out)

    def changed(name, spoil):
        maps, models = tmp_path / name / "maps", tmp_path / name / "models"
        shutil.copytree(cases.MAPS, maps)
        shutil.copytree(shipped.MODELS, models)
        spoil(maps, models)
        with monkeypatch.context() as patched:
            patched.setattr(shipped, "MODELS", models)
            patched.setattr(experiment, "MODELS", models)
            patched.setattr(experiment, "load_case", lambda case: load_case(case, maps))
            experiment._setting.cache_clear()
            try:
                return evaluate(asked, 1, ["unmodified"], out)
            except InputError as error:
                return error.message, error.expected
            finally:
                experiment._setting.cache_clear()

    def last_bit(path):
        content = path.read_bytes()
        path.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))

    def map_and_no_dqn(maps, models):  # which would not fit the map
        pixels = bytearray((maps / "case1.pgm").read_bytes())
        pixels[len(pixels) - 3] ^= 255
        (maps / "case1.pgm").write_bytes(pixels)
        shutil.rmtree(models / "case1-dqn")

    def instruction(maps, models):
        path = maps / "case1.regions.json"
        path.write_text(path.read_text().replace('"instruction": "', '"instruction": "please '))

    assert same(changed("nothing", lambda maps, models: None)) == same(kept)
    for name, spoil, what in (
        ("map", map_and_no_dqn, "task, policy dqn"),
        ("errand", instruction, "instruction"),
        ("dqn", lambda _, models: last_bit(models / "case1-dqn" / "policy.safetensors"), "policy dqn"),
        ("fm", lambda _, models: last_bit(models / "fm" / "model.safetensors"), "learned model"),
    ):
        said, expected = changed(name, spoil)
        assert said == f"the records in {out} were made with another {what}"
        assert expected.startswith("another --out")
    (out / "experiment.json").write_text(json.dumps(asked.to_json()))  # as it was before it said
    with pytest.raises(InputError, match="does not say") as caught:
        evaluate(asked, 2, ["unmodified"], out)
    assert "report" in caught.value.expected
    assert results.write(out)["runs"] == 1


def test_a_margin_is_calibrated_on_other_runs_and_kept(monkeypatch, tmp_path):
    monkeypatch.setattr(calibration, "RUNS", 9)
    monkeypatch.setattr(calibration, "ALPHA", 0.1)  # which asks for 9 at least
    asked = "ours@conformal/8"
    chosen = calibration.calibrated(EXPERIMENT, asked, tmp_path, 1)
    kept = json.loads((tmp_path / "calibration.json").read_text())["conformal/8"]
    assert chosen == f"ours@{math.ceil(1e3 * kept['margin']) / 1e3:g}/8"
    assert 0.03 < kept["margin"] < 0.06  # some 100 motions of sigma 0.01 m and 0.5 degrees
    assert kept["seed"] != EXPERIMENT.seed
    monkeypatch.setattr(calibration, "evaluate", None)  # not asked again
    assert calibration.calibrated(EXPERIMENT, asked, tmp_path, 1) == chosen
    others = calibration.calibrated(EXPERIMENT, "paper@conformal/8", tmp_path, 1)
    assert others == chosen.replace("ours", "paper")  # no method has a margin of its own
    assert calibration.calibrated(EXPERIMENT, "ours@0.1", tmp_path, 1) == "ours@0.1"
    for garbled in (
        '{"conformal/8": {"rou',
        "[]",
        "\xff",
        '{"conformal/8": {"rounded": "a"}}',
        '{"conformal/8": 1}',
    ):
        (tmp_path / "calibration.json").write_text(garbled, "latin-1")
        with pytest.raises(InputError, match=r"calibration\.json is no calibration"):
            calibration.calibrated(EXPERIMENT, asked, tmp_path, 1)


@pytest.fixture
def redis(tmp_path):
    store = EmbeddedStore(tmp_path)
    store.join()
    yield store.url
    store.leave()


@pytest.fixture
def threads(redis):
    """For campaigns. One whose worker has ended waits for another, until the store is gone."""
    pool = ThreadPoolExecutor()
    yield pool
    pool.shutdown(wait=False)


def listening(url):
    return Worker.all(queue=Queue(QUEUE, connection=Redis.from_url(url), serializer=JSONSerializer))


def worker(url, folder):
    environment = {**os.environ, "REDIS_URL": url, "SPECSHIELD_DATA_DIR": str(folder)}
    return Forked(["worker"], environment, stdout=folder / "told", stderr=folder / "told", cwd=folder)


def learner(worker):
    """A worker's process for what takes hours. It takes a campaign's runs too."""
    (pid,) = (pid for pid in children(worker) if "--learner" in command_line(pid))
    return pid


def returned(campaign, worker):
    """What a campaign returns, however long it takes while its worker lives."""
    wait_for(lambda: campaign.done() or worker.poll() is not None)
    assert campaign.done(), "the worker has ended"
    return campaign.result()


def test_workers_make_the_same_records_though_one_is_killed(serial, redis, threads, tmp_path):
    with pytest.raises(StoreError) as caught:
        evaluate(EXPERIMENT, 1, METHODS, redis_url=redis)
    assert "specshield worker" in caught.value.expected
    process = worker(redis, tmp_path)
    try:
        wait_for(lambda: listening(redis))
        result = threads.submit(evaluate, EXPERIMENT, RUNS, METHODS, redis_url=redis)
        while not (found := children(learner(process.pid))):
            assert process.poll() is None
            assert not result.done(), result.exception()
            time.sleep(0.01)
        # Somebody waits for a campaign: its runs are made at the priority that the worker was started with.
        assert os.getpriority(os.PRIO_PROCESS, found[0]) == os.getpriority(os.PRIO_PROCESS, 0)
        os.kill(found[0], signal.SIGKILL)
        assert same(returned(result, process)) == same(serial)
    finally:
        process.send_signal(signal.SIGTERM)
        process.wait(HUNG)


@needs_redis
def test_workers_on_a_cluster_take_runs_too(serial, tmp_path):
    asked = ["evaluate", "--case", "1", "--runs", "1", "--noise", "gaussian", "--seed", "5"]
    with cluster(tmp_path / "nodes") as store:
        environment = {**os.environ, "REDIS_URL": store.url, "SPECSHIELD_DATA_DIR": str(tmp_path / "data")}
        command = [sys.executable, "-m", "specshield.cli", "worker"]  # not forked: see READ_AT_IMPORT
        process = subprocess.Popen(command, env=environment)
        try:
            names = f"*workers:{QUEUE}"
            nodes = store.nodes
            wait_for(lambda: process.poll() is not None or any([*node.scan_iter(names)] for node in nodes))
            assert process.poll() is None, "the worker has ended"
            asked += ["--methods", ",".join(METHODS), "--redis", store.url, "--out", str(tmp_path / "out")]
            done = subprocess.run([sys.executable, "-m", "evaluation", *asked], timeout=HUNG)
            assert done.returncode == 0
            assert same(read(tmp_path / "out" / "case1" / "gaussian")) == same(serial[:2])
        finally:
            process.terminate()
            process.wait(HUNG)


@pytest.mark.parametrize(
    ("url", "said"),
    [("sentinel://h", "not the URL of a store"), ("redis+sentinel://127.0.0.1:1/s", "cannot be reached")],
)
def test_a_store_that_is_none_or_away_is_told_in_words(url, said):
    with pytest.raises((InputError, StoreError), match=said) as caught:
        evaluate(EXPERIMENT, 1, METHODS, redis_url=url)
    assert caught.value.path == "redis"


def test_runs_that_the_store_forgets_are_given_out_again_but_not_for_ever(serial, redis, threads, tmp_path):
    process, store = worker(redis, tmp_path), Redis.from_url(redis)

    def forget():
        return store.delete(*jobs) if (jobs := store.keys("rq:job:*")) else 0

    try:
        wait_for(lambda: listening(redis))
        stopped = learner(process.pid)
        os.kill(stopped, signal.SIGSTOP)  # takes none
        try:
            result = threads.submit(evaluate, EXPERIMENT, 1, METHODS, redis_url=redis)
            while not result.done():
                forget()
                time.sleep(0.01)
            with pytest.raises(SpecshieldError, match="runs 0 to 0 were lost 3 times"):
                result.result()
            result = threads.submit(evaluate, EXPERIMENT, 1, METHODS, redis_url=redis)
            wait_for(lambda: forget() or result.done())
        finally:
            os.kill(stopped, signal.SIGCONT)
        assert same(returned(result, process)) == same(serial[:2])
    finally:
        process.send_signal(signal.SIGTERM)
        process.wait(HUNG)


def test_a_drawn_house_is_a_case_like_another():
    """It is the same in every process, and the rule can be kept in it."""
    (record,) = run(Experiment("house", "drawn_0", seed=1), 0, ["ours"])
    assert (record.satisfied, record.main_done) == (True, True)
    case = Experiment("house", "drawn_0").setting.case
    assert (case.name, str(case.task.formula)) == ("drawn_0", RULE)
    again, other = load_house_case("drawn_0"), load_house_case("drawn_1")
    assert again.task.content_hash == case.task.content_hash != other.task.content_hash
    for house in (case, other):
        assert not house.task.grid.occupied[house.cell(house.target)]
        assert all(signed_distance(region, house.target) < 0.0 for region in house.task.regions.values())


def test_a_procthor_house_comes_from_a_folder_of_the_users(tmp_path):
    corners = [(0.0, 0.0), (6.0, 0.0), (6.0, 4.0), (0.0, 4.0)]
    rooms = [
        {"roomType": kind, "floorPolygon": [{"x": x + 6.0 * k, "y": 0.0, "z": z} for x, z in corners]}
        for k, kind in enumerate(("Kitchen", "LivingRoom", "Bedroom", "Bathroom"))
    ]
    (tmp_path / "row.json").write_text(json.dumps({"rooms": rooms, "walls": [], "doors": [], "objects": []}))
    with pytest.raises(NotFound):
        load_house_case(located("row", tmp_path))  # asset-sizes.json is missing
    (tmp_path / "asset-sizes.json").write_text("{}")
    assert located("drawn_0", tmp_path) == "drawn_0"
    case = Experiment("house", located("row", tmp_path)).setting.case
    assert (case.name, list(case.rooms)) == ("row", ["Kitchen", "LivingRoom", "Bedroom", "Bathroom"])
    assert 6.0 < case.target[0] < 12.0  # in the room that the rule does not name


@pytest.mark.parametrize(
    ("make", "path"),
    [
        (lambda: Experiment("house"), "house"),
        (lambda: Experiment("case1", "drawn_0"), "house"),
        (lambda: Experiment("case1", noise="fog"), "noise"),
        (lambda: Experiment("case1", model="oracle"), "model"),
        (lambda: Experiment("house", "nowhere").setting, "house"),
        (lambda: EXPERIMENT.setting.method("magic"), "methods"),
        (lambda: EXPERIMENT.setting.method("ours@much"), "methods"),
        (lambda: EXPERIMENT.setting.method("ours@-1"), "margin"),
    ],
)
def test_what_there_is_not_is_told(make, path):
    with pytest.raises((InputError, NotFound)) as caught:
        make()
    assert caught.value.path == path
    assert caught.value.expected


def test_an_experiment_survives_json():
    assert Experiment.from_json(json.loads(json.dumps(EXPERIMENT.to_json()))) == EXPERIMENT
