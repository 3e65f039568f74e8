"""The application: its parts, their start and their end."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import multiprocessing
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager

from fastapi import FastAPI
from fastapi_offline import FastAPIOffline
from starlette.types import Receive, Scope, Send

from specshield import __version__
from specshield.service import pages, problems
from specshield.service.access.keys import Keys
from specshield.service.bounds import bodies
from specshield.service.bounds.protocol import raise_file_limit
from specshield.service.description import TAGS, described
from specshield.service.heavy.heavy import Heavy
from specshield.service.leaving import heed_signals
from specshield.service.library.claims import Claims
from specshield.service.library.maps import Maps
from specshield.service.library.policies import Policies
from specshield.service.middleware import Guard, Observe
from specshield.service.routes import events, maps, pictures, policies, robots, sessions, specs, system
from specshield.service.routes.steps import StepRoutes
from specshield.service.sessions.mover import Mover
from specshield.service.sessions.sessions import Sessions
from specshield.service.settings import Settings
from specshield.service.startup import Startup, complete, prepare, until_it_may_listen
from specshield.service.state import Server
from specshield.service.storage.archive import Archive
from specshield.service.storage.archiving import ArchivingStore
from specshield.service.storage.connect import drops
from specshield.service.storage.embedded import EmbeddedStore
from specshield.service.storage.keeper import follow_parent
from specshield.service.storage.marker import check_files, stay_marked
from specshield.service.storage.objects import open_objects
from specshield.service.training.children import TrainingWorker, tend
from specshield.service.training.jobs import Jobs
from specshield.service.watch.events import Watchers
from specshield.service.watch.gauges import Gauges

AGAIN = 2.0  # [s] until a task that ended with an error is begun again. Chosen by hand.
log = logging.getLogger("specshield")
DESCRIPTION = """\
Keeps robot foundation models inside their operating rules. The model proposes a distribution over a finite
set of actions; the service answers the closest distribution that still lets a Signal Temporal Logic
specification be satisfied over the whole remaining horizon. The model is never retrained.

Metres, radians, counter-clockwise, map frame (REP-103). Errors are problem documents (RFC 9457): `type` is a
stable word, and for bad input `path`, `got` and `expected` say what was wrong. The examples work in this
order: check a formula, send a map, begin a session, decide a step, close, read the trajectory, erase.

x_t is the pose at step t, T the rule's last step (its horizon), and f the model of the robot's motions. J of
an action is 1 if a future that begins with it keeps the rule, and S_t has the actions with J = 1. pi_FM is
the model's distribution, and pi* that of the answer. rho, the robustness [m], says by how much a trajectory
keeps the rule.
"""


class Application:
    """The routes and the middlewares around them. These are outside of FastAPI, whose own layers a step does
    not need and would have to wait for.
    """

    def __init__(self, routes: FastAPI, settings: Settings) -> None:
        self.routes = routes
        steps = StepRoutes(routes)
        # The guard comes before the bodies: nothing is read of a request that it refuses.
        self._around = Observe(Guard(bodies.Bodies(steps, settings), settings.hosts))

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        scope["app"] = self.routes
        if scope.get("path") == "/docs":
            scope["root_path"] = "."  # the page's addresses are relative, as a proxy may add a path
        await self._around(scope, receive, send)


def create_app(settings: Settings | None = None, embedded: EmbeddedStore | None = None) -> Application:
    """The application. It opens nothing before it starts.

    embedded: the embedded store, if this process uses it already; the application leaves it at its end.
    """
    settings = settings or Settings()
    app = FastAPIOffline(
        title="specshield",
        version=__version__,
        description=DESCRIPTION,
        openapi_tags=TAGS,
        servers=[{"url": "."}],
        lifespan=lambda app: _life(app, settings, embedded),
        redoc_url=None,
        redirect_slashes=False,  # behind a proxy's path prefix a redirect would lead astray
        generate_unique_id_function=lambda route: "_".join([*map(str, route.tags), route.name]),
        swagger_ui_parameters={"defaultModelsExpandDepth": 0, "tryItOutEnabled": True},
    )
    for module in (pages, specs, maps, robots, policies, sessions, pictures, events, system):
        app.include_router(module.router)
    problems.install(app)
    app.openapi = lambda: described(app)  # type: ignore[method-assign]
    return Application(app, settings)


@asynccontextmanager
async def _life(app: FastAPI, settings: Settings, embedded: EmbeddedStore | None) -> AsyncIterator[None]:
    if multiprocessing.parent_process() is not None:  # one of uvicorn's workers
        follow_parent()
    raise_file_limit()
    if embedded is None and settings.redis_url is None:
        embedded = EmbeddedStore(settings.data_dir)
    if embedded is not None:
        await asyncio.to_thread(embedded.join)
    url = settings.store_url
    archive, replicas = Archive(open_objects(f"{settings.files_at}/archive")), settings.store_replicas
    store = ArchivingStore(url, settings.store_timeout, settings.session_ttl, archive, replicas)
    mover, jobs = Mover(store, settings), Jobs(settings)
    library = Maps(settings, Claims(lambda: jobs.redis, settings))
    known = Policies(settings, library)
    trains = settings.redis_url is None if settings.worker is None else settings.worker
    worker = TrainingWorker(settings) if trains else None
    heavy, startup = Heavy(settings), Startup()
    marked = url, settings.files_at, settings.store_timeout

    def check() -> None:
        check_files(*marked)
        if (told := drops(jobs.redis)) is not None:
            log.warning("%s; docs/scale.md says which it should be", told)
        if worker is not None:  # comes last, since it takes a processor for a second
            with contextlib.suppress(OSError):  # `tend` logs the error and tries again
                worker.ensure()

    watchers = Watchers(store, settings.max_watchers, lambda: startup.stopping, lambda: steps.deciding)
    sessions = Sessions(settings, store, known, heavy, watchers.decided, startup.has)
    steps = sessions.steps
    own = None if settings.api_key is None else settings.api_key.get_secret_value()
    keys, gauges = Keys(store.redis, own, settings.ask_for_key), Gauges(store, jobs)
    server = Server(
        settings, store, library, known, sessions, jobs, gauges, watchers, worker, startup, heavy, keys
    )
    bodies.clear(settings.data_dir / "incoming")
    app.state.server = server
    heed_signals(startup, server.streams, settings.drain)
    running = (
        lasting(lambda: prepare(startup, check)),
        *([complete(startup)] if settings.complete else []),
        lasting(lambda: tend(embedded, worker, startup)),
        lasting(lambda: stay_marked(*marked)),
        *map(lasting, (mover.run, watchers.run, keys.follow)),
    )
    tasks = [asyncio.create_task(each) for each in running]
    try:
        await until_it_may_listen(startup, tasks[0])
        yield
    finally:
        while left := [task for task in tasks if not task.done()]:
            for task in left:  # again and again, since redis-py may swallow a cancellation
                task.cancel()
            await asyncio.wait(left, timeout=0.1)
        if worker is not None:
            await asyncio.to_thread(worker.stop)
        heavy.close()
        await store.aclose()
        if embedded is not None:
            embedded.leave()


async def lasting(begin: Callable[[], Awaitable[None]]) -> None:
    """Does what a server needs until that is done, if it ever is. After an error, as when no thread can be
    started for it, it is begun again.
    """
    while True:
        try:
            return await begin()
        except Exception:
            log.exception("a task of the server ended; it is begun again")
        await asyncio.sleep(AGAIN)
