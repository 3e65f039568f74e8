"""Bodies that come in two forms, JSON or files."""

from __future__ import annotations

from typing import Any, TypeVar

from fastapi import Request
from pydantic import TypeAdapter, ValidationError
from starlette.datastructures import UploadFile

from specshield.errors import InputError
from specshield.service.problems import from_validation

T = TypeVar("T")
MOST_PARTS = 16  # of a multipart body


def is_multipart(request: Request) -> bool:
    return request.headers.get("content-type", "").lower().startswith("multipart/form-data")


async def files(request: Request) -> dict[str, bytes]:
    """The parts of a multipart body by name. Raises InputError where two have one name."""
    async with request.form(max_files=MOST_PARTS, max_fields=MOST_PARTS) as form:
        names = [name for name, _ in form.multi_items()]
        if len(set(names)) < len(names):
            raise InputError(
                "two parts have one name", path="body", got=sorted(names), expected="each part once"
            )
        return {
            name: await part.read() if isinstance(part, UploadFile) else part.encode()
            for name, part in form.items()
        }


def parse(adapter: TypeAdapter[T], content: bytes, below: str = "") -> T:
    """`content` as JSON of this shape. Raises InputError, its path below `below`."""
    try:
        return adapter.validate_json(content)
    except ValidationError as invalid:
        found = [{**item, "loc": ("body", *item["loc"])} for item in invalid.errors(include_url=False)]
        raise from_validation(found, _body(content), below) from None


def _body(content: bytes) -> Any:
    try:
        return TypeAdapter(Any).validate_json(content)
    except ValidationError:
        return None
