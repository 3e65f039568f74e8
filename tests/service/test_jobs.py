"""Training as a job, for real: seen to go on, finished, failed, cancelled, killed."""

import os
import signal
import threading
import time
from contextlib import ExitStack
from datetime import datetime, timedelta, timezone
from pathlib import Path

import httpx
import pytest
import redis
from rq import Queue
from rq.exceptions import DequeueTimeout
from rq.serializers import JSONSerializer

from specshield.service.settings import Settings
from specshield.service.storage.embedded import EmbeddedStore
from specshield.service.training import worker
from specshield.service.training.children import TrainingWorker
from specshield.service.training.jobs import SIGN_OF_LIFE, Jobs, _alive
from specshield.service.training.worker import _Worker
from tests.service.world import ROBOT, START, grid_json
from tests.serving import ADDED, HUNG, children, command_line, free_port, runs, serving, wait_for
from tests.stores import DURABLE, answers, running

pytest.importorskip("torch")

LEARNING = Path(__file__).parents[1] / "learning_example"
PATIENT = {"SPECSHIELD_WORKER": "true", ADDED: str(LEARNING)}
TINY = {
    "updates": 20,
    "robots": 16,
    "batch": 32,
    "units": 8,
    "evaluate_every": 10,
    "evaluation_starts": 20,
    "replay": 1000,
}
LONG = {**TINY, "updates": 1_000_000, "evaluate_every": 1_000_000}
SOON, LATER = ({"method": "patient", "options": {"steps": steps}} for steps in (1, 1_000_000))
SPEC = {
    "formula": "F[0,6] Goal",
    "regions": {"Goal": {"type": "circle", "center": [2.0, 1.5], "radius": 0.5}},
}


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    """With a method that learns as SOON or LATER as a test wants, and needs no time of the processor."""
    with serving(tmp_path_factory.mktemp("training"), **PATIENT) as server:
        yield server


@pytest.fixture
def client(server):
    """What a test asked for is called off at its end: one that fails leaves the worker free for the next."""
    with httpx.Client(base_url=server.url, verify=False, timeout=None) as client:
        yield client
        for policy in client.get("/v1/policies").json()["items"]:
            if policy["status"] in ("queued", "training"):
                client.delete(f"/v1/policies/{policy['id']}")


def ask(client, **fields):
    map_id = client.post("/v1/maps", json=grid_json()).json()["id"]
    body = {"map_id": map_id, "robot": ROBOT, "spec": SPEC, "method": "dqn", "options": TINY, **fields}
    response = client.post("/v1/policies", json=body)
    assert response.status_code == 202, response.text
    return response.json()


def read(client, policy):
    """Asks again while the store is away: a machine that stands still for seconds looks like that."""
    for _ in range(60):
        response = client.get(f"/v1/policies/{policy['id']}")
        if response.status_code != 503:
            break
        time.sleep(1.0)
    assert response.status_code == 200, response.text
    return response.json()


def reach(client, policy, status):
    wait_for(lambda: read(client, policy)["status"] in (status, "failed"))
    found = read(client, policy)
    assert found["status"] == status, found
    return found


def worker_of(server):
    (pid,) = (pid for pid in children(server.process.pid) if "--until-eof" in command_line(pid))
    return pid


def learner_of(server):
    """The worker's process for what takes hours."""
    (pid,) = (pid for pid in children(worker_of(server)) if "--learner" in command_line(pid))
    return pid


def test_a_policy_is_trained_and_serves(client):
    policy = ask(client)
    assert policy["status"] in ("queued", "training")
    assert ask(client)["id"] == policy["id"]  # the same request, the same policy
    ready = reach(client, policy, "ready")
    assert ready["progress"] == 1.0
    assert 0.0 <= ready["metrics"]["satisfied"] <= 1.0
    assert ready["options"]["units"] == 8
    session = client.post(
        "/v1/sessions", json={"policy_id": policy["id"], "initial_pose": START, "allow_infeasible": True}
    )
    assert session.status_code == 201
    assert client.get("/v1/policies").json()["items"][-1]["id"]


def test_a_policy_is_computed_and_serves(client):
    ready = reach(client, ask(client, method="reachability", options={}), "ready")
    assert 0.0 < ready["metrics"]["feasible_start"] <= 1.0
    body = {"policy_id": ready["id"], "initial_pose": START}
    session = client.post("/v1/sessions", json=body)
    assert session.status_code == 201, session.text
    assert session.json()["feasible"]


def test_what_is_computed_does_not_wait_for_what_is_learned(client):
    learned = ask(client, **LATER)
    reach(client, learned, "training")
    reach(client, ask(client, method="reachability", options={}, seed=6), "ready")
    assert read(client, learned)["status"] == "training"
    client.delete(f"/v1/policies/{learned['id']}")


def test_a_run_that_cannot_be_says_why(client):
    policy = ask(client, robot={**ROBOT, "footprint": {"radius": 5.0}})
    wait_for(lambda: read(client, policy)["status"] == "failed")
    assert "no free space" in read(client, policy)["error"]


def test_a_run_tells_how_far_it_is_and_can_be_cancelled(server, client):
    policy = ask(client, options=LONG)
    reach(client, policy, "training")
    wait_for(lambda: read(client, policy)["eta_s"])
    assert 0.0 < read(client, policy)["progress"] < 1.0
    (run,) = children(learner_of(server))
    own = os.getpriority(os.PRIO_PROCESS, 0)
    threads = {int(id): os.getpriority(os.PRIO_PROCESS, int(id)) for id in os.listdir(f"/proc/{run}/task")}
    assert threads[run] == min(own + 10, 19)  # below servers, and this but once
    assert min(threads.values()) == own  # signs of life do not wait until the machine is quiet
    assert client.delete(f"/v1/policies/{policy['id']}").status_code == 204
    found = read(client, policy)
    assert (found["status"], found["error"]) == ("failed", "cancelled")
    wait_for(lambda: not Path(f"/proc/{run}").exists())
    assert read(client, policy)["error"] == "cancelled"
    assert client.delete(f"/v1/policies/{policy['id']}").status_code == 204
    assert client.get(f"/v1/policies/{policy['id']}").status_code == 404


def test_a_cancelled_run_ends_whatever_it_is_doing(server, client):
    """It may import, compile or compute for long and look at nothing else; here it stands still."""
    policy = ask(client, **LATER, seed=9)
    reach(client, policy, "training")
    (run,) = children(learner_of(server))
    os.kill(run, signal.SIGSTOP)
    assert client.delete(f"/v1/policies/{policy['id']}").status_code == 204
    wait_for(lambda: not runs(run))
    reach(client, ask(client, **SOON, seed=10), "ready")  # by the same worker, which went on
    assert read(client, policy)["error"] == "cancelled"


def test_a_killed_run_fails_with_its_reason_and_can_be_asked_for_again(server, client):
    policy = ask(client, **LATER, seed=2)
    reach(client, policy, "training")
    (run,) = children(learner_of(server))
    os.kill(run, signal.SIGKILL)
    wait_for(lambda: read(client, policy)["status"] == "failed")
    assert "signal 9" in read(client, policy)["error"]
    assert ask(client, **LATER, seed=2)["status"] in ("queued", "training")  # if the worker is quick
    client.delete(f"/v1/policies/{policy['id']}")


def test_a_run_that_takes_too_long_says_so_and_what_lengthens_its_limit(tmp_path):
    with (
        serving(tmp_path, **PATIENT, SPECSHIELD_TRAINING_TIMEOUT="2") as server,
        httpx.Client(base_url=server.url, verify=False, timeout=None) as client,
    ):
        policy = ask(client, **LATER)
        wait_for(lambda: read(client, policy)["status"] == "failed")
        error = read(client, policy)["error"]
    assert "more than the 2 s" in error
    assert "SPECSHIELD_TRAINING_TIMEOUT" in error


@pytest.mark.parametrize("status", [None, signal.SIGKILL])  # None: rq does not say how the run ended
def test_a_run_that_rq_kills_at_its_limit_says_so_too(tmp_path, status):
    """It does so a minute later where the run hears nothing: it stands still, or a kernel runs."""
    store = EmbeddedStore(tmp_path)
    store.join()
    try:
        jobs, id = Jobs(Settings(data_dir=tmp_path, synthesis_timeout=30)), "a" * 64
        jobs.start(id, "planner", "")
        worker = _Worker(store.url, jobs, ["planner"], [])
        job, _ = Queue.dequeue_any(worker.queues, 1, connection=worker.connection, serializer=JSONSerializer)
        job.ended_at = datetime.now(timezone.utc)
        job.started_at = job.ended_at - timedelta(seconds=91)
        worker._killed(job, 0, status, None)
        error = jobs.get(id).error
        assert "more than the 30 s" in error
        assert "SPECSHIELD_SYNTHESIS_TIMEOUT" in error
    finally:
        store.leave()


def test_a_run_whose_worker_is_killed_fails_and_another_worker_comes(server, client):
    policy = ask(client, **LATER, seed=3)
    reach(client, policy, "training")
    os.kill(learner_of(server), signal.SIGKILL)
    wait_for(lambda: read(client, policy)["status"] == "failed")
    assert "worker is gone" in read(client, policy)["error"]
    reach(client, ask(client, **SOON, seed=4), "ready")


def test_a_run_that_gets_no_time_of_the_processor_is_not_taken_for_dead(server, client):
    policy = ask(client, **LATER, seed=5)
    reach(client, policy, "training")
    (run,) = children(learner_of(server))
    os.kill(run, signal.SIGSTOP)
    time.sleep(SIGN_OF_LIFE + 2.0)  # its last sign of its own has passed
    assert read(client, policy)["status"] == "training"
    os.kill(run, signal.SIGCONT)


@pytest.fixture
def orphaned(tmp_path):
    """A run that learns, and whose store has just ended: its client, policy and process, and what starts the
    store again.
    """
    port = free_port()
    with ExitStack() as stack:

        def start():
            options = "--port", str(port), *DURABLE
            return stack.enter_context(running(tmp_path / "store", *options))

        store, node = start(), stack.enter_context(redis.Redis(port=port))
        wait_for(lambda: answers(node))
        own = {**PATIENT, "REDIS_URL": f"redis://127.0.0.1:{port}"}
        server = stack.enter_context(serving(tmp_path / "data", **own))
        client = stack.enter_context(httpx.Client(base_url=server.url, verify=False, timeout=None))
        policy = ask(client, **LATER)
        wait_for(lambda: read(client, policy)["eta_s"])
        (run,) = children(learner_of(server))
        store.terminate()
        store.wait()
        yield client, policy, run, start


def test_a_run_goes_on_when_the_store_comes_back(orphaned):
    """Its notes of how far it is are lost meanwhile."""
    client, policy, run, start = orphaned
    time.sleep(1.0)  # several notes, and fewer seconds than without which it is taken for dead
    start()
    before = read(client, policy)["progress"]
    wait_for(lambda: read(client, policy)["progress"] > before or not runs(run))
    assert runs(run)
    assert read(client, policy)["status"] == "training"


def test_a_worker_whose_heartbeat_finds_the_store_away_goes_on(tmp_path):
    """rq's comes every 30 s while a run lasts, and the run ends with its worker."""
    with running(tmp_path, "--port", str(port := free_port())) as store, redis.Redis(port=port) as node:
        wait_for(lambda: answers(node))
        worker = _Worker(f"redis://127.0.0.1:{port}", Jobs(Settings(data_dir=tmp_path)), ["reachability"], ())
        worker.register_birth()
        queue = Queue("any", connection=worker.connection, serializer=JSONSerializer)
        job = queue.enqueue("specshield.service.training.worker.train", "an-id", "an-attempt")
        execution = worker.prepare_execution(job)
        store.terminate()
        store.wait()
        worker.maintain_heartbeats(job, execution)
    with running(tmp_path, "--port", str(port)), redis.Redis(port=port) as node:
        wait_for(lambda: answers(node))
        worker.maintain_heartbeats(job, execution)
        assert node.ttl(worker.key) > 0


def test_a_worker_goes_on_showing_that_it_lives_after_a_process_could_not_be_begun(monkeypatch):
    """Else no policy would be made until somebody starts another worker."""
    shown = threading.Semaphore(0)

    def live():
        shown.release()
        raise BlockingIOError(11, "Resource temporarily unavailable")  # as of Popen

    monkeypatch.setattr(worker, "SIGN_OF_LIFE", 0.05)
    with worker._regularly(live):
        assert all(shown.acquire(timeout=HUNG) for _ in range(3))


def test_a_run_that_fails_while_the_store_is_away_says_why_once_it_is_back(orphaned):
    client, policy, run, start = orphaned
    os.kill(run, signal.SIGALRM)  # as rq tells it that its time is over
    time.sleep(1.0)  # it tries meanwhile
    start()
    wait_for(lambda: read(client, policy)["status"] == "failed" and not runs(run))
    assert "SPECSHIELD_TRAINING_TIMEOUT" in read(client, policy)["error"]


def test_a_worker_that_is_told_to_stop_hands_its_run_back_before_those_that_wait(server, client):
    running, waiting = (ask(client, **LATER, seed=seed) for seed in (7, 8))
    reach(client, running, "training")
    stopped = learner_of(server)
    (run,) = children(stopped)
    os.kill(stopped, signal.SIGTERM)
    wait_for(lambda: not any(Path(f"/proc/{pid}").exists() for pid in (stopped, run)))
    assert read(client, running)["status"] in ("queued", "training")  # not failed: the next worker has it
    reach(client, running, "training")
    wait_for(lambda: read(client, running)["eta_s"])  # known once the next worker has gone on
    assert read(client, running)["status"] == "training"
    assert read(client, waiting)["status"] == "queued"
    for policy in (running, waiting):
        client.delete(f"/v1/policies/{policy['id']}")


def test_nothing_trains_on_without_its_server(tmp_path):
    with serving(tmp_path, **PATIENT) as server:
        with httpx.Client(base_url=server.url, verify=False, timeout=None) as client:
            policy = ask(client, **LATER)
            reach(client, policy, "training")
        worker, learner = worker_of(server), learner_of(server)
        (run,) = children(learner)
        server.kill()
        wait_for(lambda: not any(Path(f"/proc/{pid}").exists() for pid in (worker, learner, run)))
    with serving(tmp_path) as server:  # no worker this time
        found = httpx.get(f"{server.url}/v1/policies/{policy['id']}", timeout=None, verify=False).json()
        assert found["status"] == "queued"  # the worker, told to stop, handed it back


def test_what_nobody_makes_says_so_and_a_worker_that_dies_as_it_starts_is_not_offered(tmp_path):
    store = EmbeddedStore(tmp_path)
    store.join()
    try:
        jobs = Jobs(Settings(data_dir=tmp_path))
        jobs.start("a" * 64, "planner", "")
        waiting = jobs.get("a" * 64)
        assert (waiting.status, "none is running" in waiting.error) == ("queued", True)
        jobs.worker_lives(["planner"])
        assert jobs.get("a" * 64).error is None
    finally:
        store.leave()
    away = Settings(data_dir=tmp_path / "data", REDIS_URL=f"redis://127.0.0.1:{free_port()}")
    worker = TrainingWorker(away)
    worker.ensure()
    assert "planner" in worker.methods  # until its first sign of life nobody knows better
    wait_for(lambda: not worker.methods)
    worker.ensure()
    assert worker._alive
    assert worker.methods == []
    worker.stop()


def test_a_worker_waits_for_work_longer_than_the_store_may_take_to_answer(tmp_path):
    """The worker's signs of life leave connections of the short limit behind, which must not be waited on."""
    store = EmbeddedStore(tmp_path)
    store.join()
    try:
        jobs = Jobs(Settings(data_dir=tmp_path, store_timeout=0.2))
        jobs.worker_lives(["planner"])
        worker = _Worker(store.url, jobs, ["planner"], [])
        with pytest.raises(DequeueTimeout):  # rq's word for an empty queue
            Queue.dequeue_any(worker.queues, 1, connection=worker.connection)
        assert worker.connection.connection_pool.get_connection().socket_timeout > worker.dequeue_timeout
    finally:
        store.leave()


def test_a_run_that_left_the_queue_and_never_began_fails_and_can_be_asked_for_again(tmp_path):
    """Its worker was killed in the moment between taking it and the first sign of life."""
    store = EmbeddedStore(tmp_path)
    store.join()
    try:
        jobs, id = Jobs(Settings(data_dir=tmp_path)), "a" * 64
        jobs.worker_lives(["planner"])
        jobs.start(id, "planner", "")
        wait_for(lambda: not jobs.redis.exists(_alive(id)))
        assert jobs.get(id).status == "queued"  # it waits, for however long
        worker = _Worker(store.url, jobs, ["planner"], [])
        job, _ = Queue.dequeue_any(worker.queues, 1, connection=worker.connection, serializer=JSONSerializer)
        wait_for(lambda: jobs.get(id).status == "failed")
        assert "worker is gone" in jobs.get(id).error
        jobs.start(id, "planner", "")
        assert jobs.get(id).status == "queued"
        assert not jobs.report(*job.args, status="training")  # the worker was only slow, and comes too late
    finally:
        store.leave()


def test_the_owners_of_keys_take_turns_in_a_queue(tmp_path):
    """One that asks for many policies does not keep another's one waiting for all of them."""
    store = EmbeddedStore(tmp_path)
    store.join()
    try:
        jobs, asked = Jobs(Settings(data_dir=tmp_path)), iter("abcdefghijklmn")
        worker = _Worker(store.url, jobs, ["planner"], [])

        def start(*owners):
            for owner in owners:
                jobs.start(f"{owner}-{next(asked)}", "planner", owner)

        def take(count):
            for _ in range(count):
                job, _ = Queue.dequeue_any(
                    worker.queues, 1, connection=worker.connection, serializer=JSONSerializer
                )
                worker.prepare_execution(job)
                yield job.args[0]

        start("alice", "alice", "alice", "bob", "bob", "", "alice")
        assert list(take(2)) == ["alice-a", "bob-d"]  # which are now made, by two workers
        start("carol", "bob")
        assert list(take(7)) == ["-f", "carol-h", "alice-b", "bob-e", "alice-c", "bob-i", "alice-g"]

        start("dave", "dave", "dave", "dave", "erin")
        for owner in ("dave", "frank", "erin", "dave"):  # the second asks for it as his first one
            jobs.ask_too("dave-m", "planner", owner)
        assert list(take(5)) == ["dave-j", "erin-n", "dave-m", "dave-k", "dave-l"]
        jobs.ask_too("dave-m", "planner", "gina")  # it is being made
        assert jobs.counts()[0]["planner", "queued"] == 0
    finally:
        store.leave()
