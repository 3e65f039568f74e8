"""Bodies that come in two forms, JSON or files."""

from __future__ import annotations

from typing import Any, TypeVar

from fastapi import Request
from pydantic import TypeAdapter, ValidationError
from starlette.datastructures import UploadFile

from specshield.errors import InputError
from specshield.service.problems import from_validation

T = TypeVar("T")


def is_multipart(request: Request) -> bool:
    return request.headers.get("content-type", "").lower().startswith("multipart/form-data")


async def parts(request: Request, *names: str) -> list[bytes]:
    """The parts of a multipart body, which has to have these and no others."""
    async with request.form(max_files=len(names), max_fields=len(names)) as form:
        found = {name: form.getlist(name) for name in form}
        if sorted(found) != sorted(names) or any(len(values) != 1 for values in found.values()):
            raise InputError(
                "the parts are not the ones expected",
                path="body",
                got=sorted(found),
                expected=" and ".join(names),
            )
        values = [found[name][0] for name in names]
        return [await value.read() if isinstance(value, UploadFile) else value.encode() for value in values]


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


def request_body(
    required: str, json: TypeAdapter[Any], example: Any, files: dict[str, str]
) -> dict[str, Any]:
    """OpenAPI of such a body. files: what each part holds."""
    properties = {
        name: {"type": "string", "format": "binary", "description": text} for name, text in files.items()
    }
    multipart = {"schema": {"type": "object", "required": list(files), "properties": properties}}
    schema = json.json_schema(ref_template="#/components/schemas/{model}")
    schema.pop("$defs", None)
    return {
        "requestBody": {
            "required": True,
            "description": required,
            "content": {
                "application/json": {"schema": schema, "example": example},
                "multipart/form-data": multipart,
            },
        }
    }
