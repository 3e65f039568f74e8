"""The settings of a server, all of them environment variables."""

from __future__ import annotations

import os
import re
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AliasChoices, Field, SecretStr, ValidationError, ValidationInfo, field_validator
from pydantic_settings import BaseSettings, SettingsConfigDict

from specshield import shipped
from specshield.errors import InputError
from specshield.service.access.site import AUTHORITY
from specshield.service.storage.connect import FAILURES, FORMS, connect, is_cluster
from specshield.service.storage.embedded import EmbeddedStore

ALIKE = 0.9  # difflib's ratio for a misspelt name; Kubernetes' SPECSHIELD_PORT, _SERVICE_HOST... have less
Count = Annotated[int, Field(ge=1)]
AnyCount = Annotated[int, Field(ge=0)]
Seconds = Annotated[float, Field(gt=0, le=24 * 3600)]  # timers do not take every number
# At most ten years: the store, the calendar and the alarms of a process do not take every number [s].
LongSeconds = Annotated[int, Field(ge=1, le=10 * 365 * 24 * 3600)]
HEADER_TEXT = re.compile(r"[!-~]([ -~]*[!-~])?")


class Settings(BaseSettings):
    """Each variable is `SPECSHIELD_` and the field's name in upper case; REDIS_URL also works without it."""

    model_config = SettingsConfigDict(
        env_prefix="SPECSHIELD_", frozen=True, extra="ignore", env_ignore_empty=True
    )

    data_dir: Path = Path("data")  # uploaded maps, trained policies, the embedded store
    # Folder or fsspec URL (s3://bucket/prefix) of maps, policies and archived sessions, the same for all
    # servers and workers of one store. By default, the data folder.
    data_url: str | None = None
    models_dir: Path = shipped.MODELS  # policies that every key may use, one folder each
    maps_dir: Path = shipped.MAPS  # maps that every key may use, <name>.yaml with image
    # The store (storage/connect.py has the forms). By default the server starts its own.
    redis_url: str | None = Field(
        None, validation_alias=AliasChoices("redis_url", "REDIS_URL", "SPECSHIELD_REDIS_URL")
    )
    store_timeout: Seconds = 2.0  # longest wait for the store
    # How many replicas of the store at REDIS_URL need to have a step before it is answered.
    store_replicas: int = Field(0, ge=0, le=8)
    api_key: SecretStr | None = None  # for `Authorization: Bearer <key>`, beside those of `specshield keys`
    # Whether a server refuses everybody, rather than nobody, while its store has no key. `serve` sets it
    # where other machines reach the server.
    ask_for_key: bool = False
    # Further names, with or without a port, that a request's Host may have, such as that of a proxy.
    # Separated by commas.
    allowed_hosts: str = ""

    max_horizon: Count = 1000  # longest horizon of a formula [steps]
    max_steps: Count = 10_000  # most steps that a session may ask for
    max_body_bytes: int = Field(1 << 20, ge=1024)  # largest request body
    max_upload_bytes: int = Field(64 << 20, ge=1024)  # largest map or policy sent
    max_bodies_bytes: int = Field(128 << 20, ge=1 << 20)  # most for all bodies that are being received
    max_body_members: int = Field(10_000, ge=100)  # most members of objects in a JSON body, uploads excepted
    # Largest spec of a policy, and largest outlines of a map's rooms, as JSON.
    max_spec_bytes: int = Field(256 << 10, ge=1024)
    max_header_bytes: int = Field(32 << 10, ge=1024)  # largest head of a request
    max_connections: int = Field(2000, ge=8)  # most connections at once to one server process
    request_timeout: Seconds = 15.0  # longest for a head or body to arrive, and for an unread answer
    min_body_rate: Count = 64 << 10  # for each so many bytes, a body may take 1 s more
    keep_alive_timeout: Seconds = 30.0  # a connection without a request is closed after this long
    heavy_timeout: Seconds = 20.0  # longest that reading an upload or drawing a map may take
    # Most memory of a process that reads an upload or draws a map [bytes].
    heavy_memory: int = Field(1 << 30, ge=256 << 20, le=1 << 50)

    max_owner_bytes: AnyCount = 8 << 30  # most that one key's maps and policies take on the disk
    max_stored_bytes: AnyCount = 32 << 30  # most that all maps and policies take on the disk
    # So much of the data folder's disk is kept free for running sessions: no other request may use it.
    disk_reserve_bytes: AnyCount = 64 << 20
    max_maps: Count = 1000  # most uploaded maps kept
    max_policies: Count = 1000  # most policies kept
    max_sessions: Count = 100_000  # most sessions in the store; those in the archive do not count
    session_ttl: LongSeconds = 7 * 24 * 3600  # a session is erased this long after its last change [s]
    # A session that has not changed for so long moves to the archive [s]; an ended one does after 60 s if
    # this is longer.
    archive_after: LongSeconds = 3600
    # Once the archive has so many bytes, no session moves there and none is begun.
    archive_bytes: int = Field(100 << 30, ge=1 << 20)
    # Once one key's sessions take so many bytes of the archive, it can begin none.
    max_owner_archive_bytes: Count = 50 << 30
    # How long a server that was told to stop goes on answering, except at /readyz [s].
    drain: float = Field(0.0, ge=0, le=3600)

    max_watchers: AnyCount = 1000  # most open streams of events, for each server process
    log_format: Literal["text", "json"] = "text"  # lines of the log, for people or for programs
    log_level: Literal["debug", "info", "warning", "error"] = "info"  # the lowest; `debug` logs each decision

    worker: bool | None = None  # whether to start a training worker; by default, if the store is embedded
    complete: bool = True  # whether to compile, once ready, the kernels that only some sessions need
    training_timeout: LongSeconds = 6 * 3600  # longest training run of a method that learns [s]
    synthesis_timeout: LongSeconds = 600  # longest run of a method that computes its policies [s]

    @field_validator("data_dir", "data_url", "redis_url", mode="before")
    @classmethod
    def _has_no_space_around(cls, place: Any) -> Any:
        if isinstance(place, str) and place != place.strip():  # it would be part of a folder's name
            raise ValueError("a value that neither begins nor ends with a space")
        return place

    @field_validator("models_dir", "maps_dir")
    @classmethod
    def _is_there(cls, folder: Path) -> Path:
        if not folder.is_dir():
            raise ValueError("a folder that exists, or the variable not set")
        return folder

    @field_validator("redis_url")
    @classmethod
    def _is_a_store(cls, url: str | None) -> str | None:
        try:
            store = connect(url) if url is not None else None
            if store is not None and not is_cluster(str(url)):
                store.connection_pool.make_connection()  # checks all options, and opens nothing yet
        except (ValueError, TypeError, *FAILURES):  # the last for a `protocol` that there is not
            raise ValueError(f"a URL such as {FORMS}") from None
        return url

    @field_validator("store_replicas")
    @classmethod
    def _has_replicas(cls, replicas: int, others: ValidationInfo) -> int:
        if replicas and others.data.get("redis_url", "") is None:
            raise ValueError("0 unless REDIS_URL is set: the store that the server starts has no replicas")
        return replicas

    @field_validator("api_key")
    @classmethod
    def _fits_a_header(cls, key: SecretStr | None) -> SecretStr | None:
        if key is not None and not HEADER_TEXT.fullmatch(key.get_secret_value()):
            raise ValueError("printable ASCII that neither begins nor ends with a space: a header carries it")
        return key

    @field_validator("allowed_hosts")
    @classmethod
    def _are_names(cls, names: str) -> str:
        if not all(AUTHORITY.fullmatch(name) for name in _listed(names)):
            raise ValueError("names such as robots.example or robots.example:8443, separated by commas")
        return names

    @property
    def hosts(self) -> frozenset[str]:
        """`allowed_hosts`, one by one."""
        return frozenset(_listed(self.allowed_hosts))

    @property
    def store_url(self) -> str:
        """The URL of the store at REDIS_URL, or of the embedded one."""
        return self.redis_url or EmbeddedStore(self.data_dir).url

    @property
    def files_at(self) -> str:
        """The folder, or the fsspec URL, of maps, policies and archived sessions."""
        return self.data_url or str(self.data_dir.resolve())

    def or_empty(self, folder: str) -> Settings:
        """These settings, with an empty folder where there is no data folder: who only reads makes none."""
        return self if self.data_dir.is_dir() else self.model_copy(update={"data_dir": Path(folder)})

    def environment(self) -> dict[str, str]:
        """The environment that gives a child process these same settings."""
        values = {f"SPECSHIELD_{name.upper()}": value for name, value in self if value is not None}
        values.pop("SPECSHIELD_REDIS_URL", None)
        if self.redis_url is not None:
            values["REDIS_URL"] = self.redis_url
        if self.api_key is not None:
            values["SPECSHIELD_API_KEY"] = self.api_key.get_secret_value()
        values["SPECSHIELD_DATA_DIR"] = self.data_dir.resolve()
        return {**os.environ, **{name: str(value) for name, value in values.items()}}


def _listed(names: str) -> list[str]:
    return [name.strip().lower() for name in names.split(",") if name.strip()]


def read_settings() -> Settings:
    """The settings of this process's environment. Raises InputError, which names the wrong variable."""
    if os.environ.get("SPECSHIELD_API_KEY") == "":  # it would count as unset, which would open the server
        name, expected = "SPECSHIELD_API_KEY", "a key, or the variable not set"
        raise InputError(f"{name} is empty", path=name, expected=expected)
    if os.environ.get("SPECSHIELD_DATA_URL", "").startswith("memory:"):
        told = "files in memory are seen by one process alone, and a server has several"
        expected = "a folder, or a URL that every process reaches"
        raise InputError(told, path="SPECSHIELD_DATA_URL", expected=expected)
    known = [f"SPECSHIELD_{field.upper()}" for field in Settings.model_fields]
    for name in os.environ:  # a misspelt setting would be ignored silently
        meant = get_close_matches(name, known, 1, ALIKE)
        if meant and name not in known:
            raise InputError(f"{name} is not a setting", path=name, expected=f"{meant[0]}, or not set")
    try:
        return Settings()
    except ValidationError as invalid:
        from specshield.service.problems import valid

        wrong = invalid.errors(include_url=False)[0]
        field = str(wrong["loc"][0]).lower().removeprefix("specshield_")
        name = "REDIS_URL" if field == "redis_url" else f"SPECSHIELD_{field.upper()}"
        secret = field in ("redis_url", "api_key")  # a URL may hold a password
        shown = "" if secret else f": {wrong['input']!r}"
        raise InputError(f"{name} is not valid{shown}", path=name, expected=valid(wrong)) from None
