"""Makes calls that take seconds, one after the other, in a thread that does not delay the server's end."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from queue import SimpleQueue
from threading import Lock, Thread
from typing import TypeVar

T = TypeVar("T")


class Background:
    """Like an executor with one thread, but the interpreter does not wait for the thread at its end."""

    def __init__(self, name: str) -> None:
        self._name, self._calls, self._lock = name, SimpleQueue[Callable[[], None]](), Lock()
        self._thread: Thread | None = None

    def submit(self, function: Callable[..., T], *args: object) -> Future[T]:
        future = Future[T]()

        def call() -> None:
            if not future.set_running_or_notify_cancel():
                return
            try:
                future.set_result(function(*args))
            except BaseException as error:
                future.set_exception(error)

        with self._lock:
            if self._thread is None:
                thread = Thread(target=self._run, name=self._name, daemon=True)
                thread.start()  # may fail; the next call then tries again
                self._thread = thread
        self._calls.put(call)
        return future

    def _run(self) -> None:
        while True:
            self._calls.get()()
