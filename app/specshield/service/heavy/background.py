"""Calls that take seconds, made in turn, in a thread that a server which stops does not wait for."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from queue import SimpleQueue
from threading import Lock, Thread
from typing import TypeVar

T = TypeVar("T")


class Background:
    """As an executor with one thread; but the interpreter waits for an executor's threads when it ends."""

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
                thread.start()  # may fail, and is tried again with the next call
                self._thread = thread
        self._calls.put(call)
        return future

    def _run(self) -> None:
        while True:
            self._calls.get()()
