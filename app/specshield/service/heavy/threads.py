"""The threads of one server process. Sessions are begun and switched in them, and some steps are decided."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import ParamSpec, TypeVar

from specshield.cores import cores
from specshield.service.library import files
from specshield.service.watch import logs

P = ParamSpec("P")
T = TypeVar("T")
OWNERS = 64  # whose threads are kept. The threads of others end after what they have to do. Chosen by hand.


class Threads(ThreadPoolExecutor):
    """Each owner has threads of its own, so that no request waits for work that another owner has asked for.
    The owner is that of the request that is being answered. Callers without a key share the threads of this
    executor itself.
    """

    def __init__(self) -> None:
        super().__init__(cores(), "decide")
        self._owners = files.Recent[ThreadPoolExecutor](OWNERS)

    def submit(self, function: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        if not (owner := logs.owner()):
            return super().submit(function, *args, **kwargs)
        threads = self._owners.get(owner, lambda: ThreadPoolExecutor(cores(), "decide"))
        return threads.submit(function, *args, **kwargs)
