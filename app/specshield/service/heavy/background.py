"""Makes calls that take seconds, one after the other, in a thread that does not delay the server's end."""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Callable
from concurrent.futures import Future
from threading import Lock, Semaphore, Thread
from typing import TypeVar

T = TypeVar("T")


class Background:
    """Like an executor with one thread, but the interpreter does not wait for the thread at its end.

    Owners take turns: if one asks for a hundred calls, another owner's next call waits for one of them.
    """

    def __init__(self, name: str) -> None:
        self._name, self._lock, self._waiting = name, Lock(), Semaphore(0)
        self._lines: OrderedDict[str, deque[Callable[[], None]]] = OrderedDict()
        self._thread: Thread | None = None

    def submit(self, function: Callable[..., T], *args: object, owner: str = "") -> Future[T]:
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
            self._lines.setdefault(owner, deque()).append(call)
        self._waiting.release()
        return future

    def _run(self) -> None:
        while True:
            self._waiting.acquire()
            self._next()()

    def _next(self) -> Callable[[], None]:
        """The oldest call of the owner that had a turn longest ago."""
        with self._lock:
            owner, line = self._lines.popitem(last=False)
            call = line.popleft()
            if line:
                self._lines[owner] = line
            return call
