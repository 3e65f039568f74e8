"""The worker, `specshield worker`: one process takes jobs, and forks a process for each."""

from __future__ import annotations

import logging
import logging.config
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from typing import Any

from rq import Worker, get_current_job
from rq.job import Job
from rq.serializers import JSONSerializer
from rq.timeouts import JobTimeoutException
from rq.worker import DequeueStrategy

from specshield.errors import SpecshieldError, StoreError
from specshield.policy.methods import METHODS, Run, available, missing
from specshield.policy.options import read_options
from specshield.service.settings import Settings
from specshield.service.storage.connect import FAILURES, connect_to_jobs, reaching
from specshield.service.storage.embedded import EmbeddedStore
from specshield.service.storage.keeper import at_end_of_input, follow_parent
from specshield.service.storage.marker import check_files
from specshield.service.training.jobs import AGAIN, SIGN_OF_LIFE, Jobs, learns, queue_of
from specshield.service.watch import logs

CONNECT = 5.0  # [s] for a connection to the store; an answer may take until there is work
PATIENCE = 60  # tries, a second or more apart, to note the end of a run; chosen by hand
log = logging.getLogger("specshield")


def serve(settings: Settings, until_eof: bool, others: Sequence[str] = (), learner: bool = False) -> None:
    """Works until it is told to stop. until_eof: also until standard input ends, as the server that started
    this worker has ended.

    Runs of methods that learn take hours, other runs seconds. So the former have a second process, which this
    one starts. learner: whether this is that process. others: queues with jobs of other packages, which the
    second process takes too. Raises StoreError if the store is lost for good.
    """
    logging.config.dictConfig(logs.config(settings.log_format, settings.log_level))
    held = tuple[int, ...]()  # descriptors that keep the embedded store running: handing a run back needs it
    if settings.redis_url is None:
        embedded = EmbeddedStore(settings.data_dir)
        embedded.join()
        held = embedded.held
    url = os.environ["REDIS_URL"] = settings.store_url  # for the runs, and for the second process
    with suppress(StoreError):  # rq logs that the store is away
        check_files(url, settings.files_at, settings.store_timeout)
    jobs = Jobs(settings)
    if until_eof:
        at_end_of_input(lambda: os.kill(os.getpid(), signal.SIGTERM))
    methods = available()  # methods that are installed later are those of the next worker
    learning = [name for name in methods if learns(name)]
    if not learner:
        _tell(methods)
    methods = learning if learner else [name for name in methods if name not in learning]
    second: subprocess.Popen[bytes] | None = None

    def live() -> None:
        nonlocal second
        jobs.worker_lives(methods)
        if (learning or others) and not learner and (second is None or second.poll() is not None):
            # It ends with this process: its standard input is a pipe.
            command = [sys.executable, "-m", "specshield.cli", "worker", "--until-eof", "--learner"]
            second = subprocess.Popen(command, stdin=subprocess.PIPE, pass_fds=held)

    with _regularly(live), reaching():
        of = _Worker(url, jobs, methods, others if learner else ())
        # So that no queue waits for all of another one.
        of.work(logging_level="WARNING", dequeue_strategy=DequeueStrategy.ROUND_ROBIN)
    raise StoreError(
        "the worker lost the store and cannot go on; rq's last lines in the log say why",
        expected="a store that answers",
    )


def _tell(methods: Sequence[str]) -> None:
    """Logs the methods by which this worker makes policies, and those for which a module is missing."""
    log.info("this worker makes policies by %s", ", ".join(methods))
    for name, method in METHODS.usable():
        if name not in methods:
            modules = " and ".join(missing(method))
            log.warning("this worker makes no policies by %s: %s is not installed", name, modules)


class _Worker(Worker):
    """rq's worker. On SIGTERM it ends the run at once and puts it back into the queue: the next worker goes
    on from the run's checkpoint.
    """

    max_connection_wait_time = 1.0  # [s] between two tries to reach the store; rq would wait up to 60 s

    def __init__(self, url: str, jobs: Jobs, methods: Sequence[str], others: Sequence[str]) -> None:
        self._training = [queue_of(method) for method in methods]
        # A client of its own: rq waits for work longer than any answer of the store may take, and sets the
        # time limit of these connections to fit before the first one is made.
        connection = connect_to_jobs(url, socket_timeout=None, socket_connect_timeout=CONNECT)
        # rq asks for its own address, which redis-py cannot parse if a unix socket's path has " " or "=".
        connection.set_response_callback("CLIENT INFO", lambda answer, **_: {"addr": "unknown"})
        super().__init__(
            [*self._training, *others],
            connection=connection,
            serializer=JSONSerializer,
            work_horse_killed_handler=self._killed,
            worker_ttl=60,
        )
        self._jobs = jobs
        self._running: Any = None

    def execute_job(self, job: Job, queue: Any) -> None:
        def live() -> None:
            if not self._jobs.sign_of_life(*job.args) and (run := self.horse_pid):  # 0: it is not running
                self._stopped_job_id = job.id  # so rq knows that it was ended on purpose
                with suppress(ProcessLookupError):
                    os.killpg(run, signal.SIGKILL)

        self._running = job
        # The worker too gives the run's signs of life: on a busy machine the run itself may be too slow.
        with _regularly(live) if job.origin in self._training else nullcontext():
            super().execute_job(job, queue)
        self._running = None

    def maintain_heartbeats(self, job: Job, execution: Any) -> None:
        with suppress(*FAILURES):  # the next one may succeed; rq would end the worker with its run
            super().maintain_heartbeats(job, execution)

    def request_stop(self, signum: int, frame: Any) -> None:
        if self._running is not None:
            self.kill_horse()
            if self._running.origin in self._training:
                self._jobs.hand_back(*self._running.args)
        raise SystemExit(0)

    def _killed(self, job: Any, pid: int, status: int, usage: Any) -> None:
        if job.origin not in self._training:
            return
        killed = status and os.WIFSIGNALED(status)
        how = f"by signal {os.WTERMSIG(status)}" if killed else f"with status {status}"
        if killed and os.WTERMSIG(status) == signal.SIGKILL:
            how += " (the kernel does this when memory runs out)"
        late = (job.ended_at - job.started_at).total_seconds() > job.timeout  # rq kills late runs
        reason = _too_long(job) if late else f"the process that made it ended {how}"
        self._jobs.end(job.args[0], job.id, f"{reason}; {AGAIN}")


def train(id: str, attempt: str) -> None:
    """Makes a policy, in a process for this run. If that fails, the policy's `error` says why."""
    follow_parent()
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    settings = Settings()
    jobs = Jobs(settings)
    jobs.sign_of_life(id, attempt)  # comes first: a run with the status `training` needs one
    if not jobs.report(id, attempt, status="training"):
        return  # cancelled, or asked for again
    logs.tell("making a policy", policy_id=id)
    with _regularly(lambda: jobs.sign_of_life(id, attempt)):
        os.nice(10)  # of this thread and those that it starts, not of the signs of life: see heavy/heavy.py
        reason = None
        try:
            _train(settings, jobs, id, attempt)
        except SpecshieldError as error:
            reason = str(error)
        except JobTimeoutException:
            reason = f"{_too_long(get_current_job())}; {AGAIN}"
        except Exception as error:
            log.exception("training of %s", id)  # callers do not get its text, which may have paths or code
            reason = f"an unexpected {type(error).__name__}; the worker's log says more"
        for _ in range(PATIENCE):  # the store may be away for a while
            with suppress(StoreError):
                jobs.end(id, attempt, reason)
                break
            time.sleep(1.0)


def _too_long(job: Any) -> str:
    setting = "TRAINING" if learns(job.origin.removeprefix(queue_of(""))) else "SYNTHESIS"
    return f"it took more than the {job.timeout} s that SPECSHIELD_{setting}_TIMEOUT allows"


def _train(settings: Settings, jobs: Jobs, id: str, attempt: str) -> None:
    # Imported here, in the process of the run, so that the worker itself stays small.
    from specshield.policy.notices import notices
    from specshield.service.library.claims import Claims
    from specshield.service.library.maps import Maps
    from specshield.service.library.policies import Policies

    policies = Policies(settings, Maps(settings, Claims(lambda: jobs.redis, settings)))
    about = policies.record(id).about

    def on_progress(done: float, seconds_left: float, said: str) -> None:
        with suppress(StoreError):  # the next report may succeed
            jobs.report(id, attempt, progress=round(done, 4), eta_s=round(seconds_left, 1))

    method = METHODS.get(about.method)
    run = Run(about.seed, about.spec, policies.checkpoints(id), on_progress)
    task = policies.task(about)
    policy = method.make(task, read_options(method.options, about.options), run)
    weights = policy.weights()
    said = notices(method.load(weights, policy.card, task))
    for notice in said:
        log.warning("policy %s: %s", id, notice)
    card = {**policy.card, "map_id": about.map_id, "seed": about.seed, "warnings": list(said)}
    policies.finish(id, weights, card)


@contextmanager
def _regularly(action: Callable[[], object]) -> Iterator[None]:
    """During the block, a thread repeats the action several times within SIGN_OF_LIFE."""
    over = threading.Event()

    def repeat() -> None:
        while not over.is_set():
            try:
                action()
            except (StoreError, OSError) as error:  # OSError: no process can be begun just now
                log.warning("%s", error)
            over.wait(SIGN_OF_LIFE / 5)

    thread = threading.Thread(target=repeat, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join(1.0)
