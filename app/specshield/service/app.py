"""The application: its parts, their life, and its description."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import multiprocessing
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from functools import partial
from typing import Any

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi
from fastapi_offline import FastAPIOffline

from specshield import __version__
from specshield.errors import SpecshieldError, StoreError
from specshield.service import pages, problems
from specshield.service.access.keys import Keys
from specshield.service.bounds import body
from specshield.service.bounds.bodies import Bodies
from specshield.service.drain import drain_at_sigterm
from specshield.service.heavy.heavy import Heavy
from specshield.service.library.claims import Claims
from specshield.service.library.maps import Maps
from specshield.service.library.policies import Policies
from specshield.service.middleware import Guard, Observe, guarded
from specshield.service.routes import events, maps, pictures, policies, robots, sessions, specs, system
from specshield.service.routes.steps import StepRoute
from specshield.service.routes.stream import StreamRoute
from specshield.service.schemas.base import Problem
from specshield.service.sessions.mover import Mover
from specshield.service.sessions.sessions import Sessions
from specshield.service.settings import Settings
from specshield.service.startup import Startup, prepare
from specshield.service.state import Server, problem_documents
from specshield.service.storage.archive import Archive
from specshield.service.storage.archiving import ArchivingStore
from specshield.service.storage.embedded import EmbeddedStore
from specshield.service.storage.keeper import follow_parent
from specshield.service.storage.marker import check_files
from specshield.service.storage.objects import open_objects
from specshield.service.training.children import TrainingWorker, tend, wants_worker
from specshield.service.training.jobs import Jobs
from specshield.service.watch.events import Watchers
from specshield.service.watch.gauges import Gauges

log = logging.getLogger("specshield")
DESCRIPTION = """\
Keeps robot foundation models inside their operating rules. The model proposes a distribution over a finite
set of actions; the service answers the closest distribution that still lets a Signal Temporal Logic
specification be satisfied over the whole remaining horizon. The model is never retrained.

Metres, radians, counter-clockwise, map frame (REP-103). Errors are problem documents (RFC 9457): `type` is a
stable word, and for bad input `path`, `got` and `expected` say what was wrong. The examples work in this
order: check a formula, send a map, begin a session, decide a step, close, read the trajectory, erase.
"""
TAGS = [
    {"name": "specifications", "description": "Formulas of Signal Temporal Logic."},
    {"name": "maps", "description": "Occupancy grids with named areas."},
    {"name": "robots", "description": "What the robots that came with the server can do."},
    {"name": "policies", "description": "What certifies that an action still has a satisfying future."},
    {"name": "sessions", "description": "Episodes: one robot, one specification, one decision a step."},
    {"name": "system", "description": "Life, readiness, metrics."},
]

LINKS = {  # which answers name a thing, by what parameter, and the operations on that thing
    ("/v1/maps", "201"): ("map_id", ("maps_read", "maps_image")),
    ("/v1/policies", "202"): ("policy_id", ("policies_read",)),
    ("/v1/sessions", "201"): (
        "session_id",
        ("sessions_read", "sessions_step", "sessions_switch", "sessions_close", "sessions_trajectory"),
    ),
}  # fmt: skip


def create_app(settings: Settings | None = None, embedded: EmbeddedStore | None = None) -> FastAPI:
    """The application. Nothing is opened before it starts.

    embedded: this process's share in the embedded store, where it has one already; left at the end.
    """
    settings = settings or Settings()
    app = FastAPIOffline(
        title="specshield",
        version=__version__,
        description=DESCRIPTION,
        openapi_tags=TAGS,
        lifespan=lambda app: _life(app, settings, embedded),
        redoc_url=None,
        generate_unique_id_function=lambda route: "_".join([*map(str, route.tags), route.name]),
        swagger_ui_parameters={"defaultModelsExpandDepth": 0, "tryItOutEnabled": True},
    )
    for module in (pages, specs, maps, robots, policies, sessions, pictures, events, system):
        app.include_router(module.router)
    app.include_router(events.overview)
    problems.install(app)
    app.add_middleware(StepRoute)  # the innermost
    app.add_middleware(StreamRoute, max_message=settings.max_body_bytes)
    app.add_middleware(Bodies, settings=settings)  # nothing is read for who may not ask
    app.add_middleware(Guard, allowed_hosts=settings.hosts)
    app.add_middleware(Observe)  # the outermost
    app.openapi = lambda: _openapi(app)  # type: ignore[method-assign]
    return app


@asynccontextmanager
async def _life(app: FastAPI, settings: Settings, embedded: EmbeddedStore | None) -> AsyncIterator[None]:
    if multiprocessing.parent_process() is not None:  # one of uvicorn's workers
        follow_parent()
    if embedded is None and settings.redis_url is None:
        embedded = EmbeddedStore(settings.data_dir)
    if embedded is not None:
        await asyncio.to_thread(embedded.join)
    url = embedded.url if embedded is not None else str(settings.redis_url)
    archive = Archive(open_objects(f"{settings.files_at}/archive"))
    store = ArchivingStore(url, settings.store_timeout, settings.session_ttl, archive)
    check = partial(check_files, url, settings.files_at, settings.store_timeout)
    mover, jobs = Mover(store, settings), Jobs(url, settings)
    claims = Claims(lambda: jobs.redis, settings)
    library = Maps(settings, claims)
    known = Policies(settings, library, claims)
    worker = TrainingWorker(settings) if wants_worker(settings) else None
    heavy, startup = Heavy(settings), Startup()
    watchers = Watchers(store, settings.max_watchers, lambda: startup.stopping)
    sessions = Sessions(settings, store, known, heavy, watchers.decided)
    own = None if settings.api_key is None else settings.api_key.get_secret_value()
    keys, gauges = Keys(store.redis, own), Gauges(store, jobs)
    server = Server(
        settings,
        store,
        library,
        known,
        sessions,
        jobs,
        gauges,
        watchers,
        worker,
        startup,
        heavy,
        keys,
        claims,
    )
    body.clear(settings.data_dir / "incoming")
    app.state.server = server
    server.streams.close_at_stop()  # which comes when what follows has drained
    drain_at_sigterm(startup, settings.drain)
    running = (
        tend(embedded, worker), prepare(startup, check), mover.run(), watchers.run(), keys.follow(),
        _adopt(library, known),
    )  # fmt: skip
    tasks = [asyncio.create_task(each) for each in running]
    try:
        yield
    finally:
        for task in tasks:
            task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await asyncio.gather(*tasks)
        if worker is not None:
            await asyncio.to_thread(worker.stop)
        heavy.close()
        await store.aclose()
        if embedded is not None:
            embedded.leave()


async def _adopt(library: Maps, known: Policies) -> None:
    """Once the store answers."""
    waiting = True
    while waiting:
        waiting = False
        try:
            await asyncio.to_thread(library.adopt)
            await asyncio.to_thread(known.adopt)
        except StoreError:
            waiting = True
            await asyncio.sleep(1.0)
        except SpecshieldError as error:  # no room for them, say
            log.error("maps and policies of a time before owners stay unseen: %s", error)


def _openapi(app: FastAPI) -> dict[str, Any]:
    if app.openapi_schema is None:
        schema = get_openapi(
            title=app.title,
            version=app.version,
            description=app.description,
            routes=app.routes,
            tags=app.openapi_tags,
        )
        schemas = schema["components"]["schemas"]
        for name in (
            "HTTPValidationError",
            "ValidationError",
        ):  # FastAPI's own, which never leave this server
            schemas.pop(name, None)
        for model in (Problem, *specs.MODELS, *policies.MODELS):  # referred to by hand
            described = model.model_json_schema(ref_template="#/components/schemas/{model}")
            schemas.update(described.pop("$defs", {}))
            schemas[model.__name__] = described
        schema["components"]["securitySchemes"] = {
            "key": {"type": "http", "scheme": "bearer", "description": "Where the server asks for one."}
        }
        schema["security"] = [{}, {"key": []}]
        for path, methods in schema["paths"].items():  # what the middleware may answer
            for operation in methods.values():
                said = {"_403": "`cross-site`: a page of another origin asks."}
                said["_421"] = "`misdirected-request`: Host does not name this server."
                if guarded(path):
                    said["_401"] = "The server asks for a key, and this is not it."
                    said["_429"] = operation["responses"].get("429", {}).get("description", "")
                    said["_429"] = f"{said['_429']} `rate-limited`: wait for Retry-After.".strip()
                if path.startswith("/v1/"):
                    said["_503"] = operation["responses"].get("503", {}).get("description", "")
                    said["_503"] = f"{said['_503']} `starting`: the server is not ready yet.".strip()
                if "requestBody" in operation:
                    said["_408"] = "The body took too long to arrive."
                    said["_413"] = "The body is over the limit."
                    said["_415"] = "The body is not declared as a type that is taken here."
                added = problem_documents(**said)
                operation["responses"] |= {str(status): told for status, told in added.items()}
        for (path, status), (parameter, operations) in LINKS.items():
            schema["paths"][path]["post"]["responses"][status]["links"] = {
                name: {"operationId": name, "parameters": {parameter: "$response.body#/id"}}
                for name in operations
            }
        app.openapi_schema = schema
    return app.openapi_schema
