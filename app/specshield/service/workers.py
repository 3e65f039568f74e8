"""Several server processes under uvicorn's supervisor."""

from __future__ import annotations

from uvicorn.supervisors.multiprocess import Process


def notice_killed() -> None:
    """From now on the supervisor closes its own copy of a worker's end of the pipe between them.

    It asks each worker for a sign of life through that pipe. With the copy open, it does not see the end of
    one that is killed while it is asked, and waits as long as a worker may take to start.
    """
    start = Process.start

    def start_and_close(worker: Process) -> None:
        start(worker)
        worker.child_conn.close()

    Process.start = start_and_close  # type: ignore[assignment, method-assign]
