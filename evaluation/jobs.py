"""Runs of an experiment as jobs for `specshield worker`, on any machine that shares the Redis."""

from __future__ import annotations

import signal
import time
from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime, timedelta, timezone
from itertools import islice
from typing import TYPE_CHECKING, Any

from rq import Queue, Worker
from rq.exceptions import NoSuchJobError
from rq.job import Job, JobStatus
from rq.serializers import JSONSerializer

from specshield.errors import InputError, SpecshieldError, StoreError
from specshield.service.storage.connect import FORMS, connect_to_jobs, reaching
from specshield.service.storage.keeper import follow_parent

if TYPE_CHECKING:  # while a worker waits for jobs it loads none of the core
    from evaluation.experiment import Experiment
    from evaluation.runs import Record

QUEUE = "specshield-runs"
CHUNK = 4  # runs a job
POLL = 0.2  # [s]
CONNECT = 5.0  # [s] for a connection to the store
TIMEOUT = 3600  # [s] for a job
ATTEMPTS = 3
SILENT = timedelta(seconds=120)  # a worker that gives no sign of life for so long is taken for dead

Chunk = list[tuple[int, list[str]]]


def over_workers(
    url: str, experiment: Experiment, missing: Mapping[int, Sequence[str]]
) -> Iterator[list[Record]]:
    """The records of each run, as the workers finish them. Runs that were lost are given out again.

    missing: {run: methods}. url: of the store, as a server takes it. Raises InputError for one that is none,
    StoreError where the store cannot be reached or no worker listens, and SpecshieldError with a failed job's
    last line, or where runs are lost ATTEMPTS times.
    """
    try:
        with reaching():
            try:
                connection = connect_to_jobs(url, socket_connect_timeout=CONNECT)
            except ValueError:
                raise InputError("this is not the URL of a store", expected=f"one as {FORMS}") from None
            yield from _over_workers(connection, experiment, missing)
    except (InputError, StoreError) as error:
        error.at("redis")
        raise


def _over_workers(
    connection: Any, experiment: Experiment, missing: Mapping[int, Sequence[str]]
) -> Iterator[list[Record]]:
    from evaluation.runs import Record

    queue = Queue(QUEUE, connection=connection, serializer=JSONSerializer)
    if not Worker.all(queue=queue):
        raise StoreError(
            "no worker listens for runs", got=0, expected="`specshield worker` with this REDIS_URL"
        )
    waiting: dict[str, tuple[Chunk, int]] = {}

    def give_out(chunk: Chunk, attempt: int) -> None:
        if attempt > ATTEMPTS:
            raise SpecshieldError(
                f"the runs {chunk[0][0]} to {chunk[-1][0]} were lost {ATTEMPTS} times: their workers died or "
                "the store forgot them"
            )
        job = queue.enqueue(
            run_chunk,
            experiment.to_json(),
            chunk,
            job_timeout=TIMEOUT,
            result_ttl=TIMEOUT,
            failure_ttl=TIMEOUT,
        )
        waiting[job.id] = chunk, attempt

    left = iter(missing.items())
    while chunk := [(i, list(names)) for i, names in islice(left, CHUNK)]:
        give_out(chunk, 1)
    try:
        while waiting:
            for job_id in list(waiting):
                job = _fetched(connection, job_id)
                if job is not None and (made := _result(job)) is not None:
                    del waiting[job_id]
                    for records in made:
                        yield [Record.from_json(record) for record in records]
                elif job is None or _is_lost(job):
                    chunk, attempt = waiting.pop(job_id)
                    give_out(chunk, attempt + 1)
                else:
                    continue
                if job is not None:
                    job.delete()
            time.sleep(POLL)
    finally:
        for job_id in waiting:
            if (job := _fetched(connection, job_id)) is not None:
                job.delete()


def run_chunk(experiment: dict[str, Any], chunk: Chunk) -> list[list[dict[str, Any]]]:
    """The job: the records of each of its runs, as JSON."""
    from evaluation.experiment import Experiment
    from evaluation.runs import run

    follow_parent()
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    described = Experiment.from_json(experiment)
    return [[record.to_json() for record in run(described, i, names)] for i, names in chunk]


def _fetched(connection: Any, job_id: str) -> Job | None:
    """None where the store has forgotten the job; what a worker has written to it since is not a job."""
    try:
        return Job.fetch(job_id, connection=connection, serializer=JSONSerializer)
    except NoSuchJobError:
        return None


def _result(job: Job) -> Any:
    """None where the job has not finished, or the store has forgotten its result."""
    return job.return_value() if job.get_status(refresh=False) == JobStatus.FINISHED else None


def _is_lost(job: Job) -> bool:
    """Whether a job will never have a result. Raises SpecshieldError where its own code failed."""
    status = job.get_status(refresh=False)
    if status in (JobStatus.FAILED, JobStatus.STOPPED, JobStatus.CANCELED):
        result = job.latest_result()
        said = (result.exc_string or "").strip() if result is not None else ""
        if said.startswith("Traceback"):
            raise SpecshieldError(f"a worker could not do its runs: {said.splitlines()[-1]}")
        return True
    heartbeat: datetime | None = job.last_heartbeat
    return status == JobStatus.FINISHED or (
        status == JobStatus.STARTED
        and heartbeat is not None
        and datetime.now(timezone.utc) - heartbeat > SILENT
    )
