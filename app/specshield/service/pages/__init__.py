"""The page at `/`: files that are sent to browsers from memory.

They hold no data of any owner, so they need no key. The page asks the API for what it shows, like any caller.
"""

from __future__ import annotations

import gzip
import hashlib
from functools import cache
from pathlib import Path
from typing import NamedTuple

from fastapi import APIRouter, Request, Response

from specshield.errors import NotFound

router = APIRouter(include_in_schema=False)
FOLDER = Path(__file__).parent / "static"
TYPES = {".js": "text/javascript", ".css": "text/css", ".html": "text/html", ".svg": "image/svg+xml"}
POLICY = (  # no content from elsewhere, no scripts or styles in the HTML, and no frame around the page
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
HEADERS = {
    "Content-Security-Policy": POLICY,
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-cache",  # browsers keep a file but ask for its tag, so a new version shows at once
    "Vary": "Accept-Encoding",
}


class File(NamedTuple):
    """packed: gzip of the content. tag: the ETag, which a browser sends to ask for changes."""

    kind: str
    content: bytes
    packed: bytes
    tag: str


@cache
def files() -> dict[str, File]:
    """The files by their path below `static`: 60 kB that are read at the first request."""
    found = {}
    for path in sorted(FOLDER.rglob("*")):
        if path.suffix in TYPES:
            content = path.read_bytes()
            packed, tag = gzip.compress(content, 9, mtime=0), f'"{hashlib.sha256(content).hexdigest()[:32]}"'
            found[path.relative_to(FOLDER).as_posix()] = File(TYPES[path.suffix], content, packed, tag)
    return found


@router.get("/")
@router.get("/page/{path:path}")
async def page(request: Request, path: str = "index.html") -> Response:
    file = files().get(path)
    if file is None:
        raise NotFound(f"there is no page {path!r}", got=path, expected="the page at /, or a path of /docs")
    headers = {**HEADERS, "ETag": file.tag}
    if request.headers.get("if-none-match") == file.tag:
        return Response(status_code=304, headers=headers)
    if "gzip" in request.headers.get("accept-encoding", ""):
        return Response(file.packed, media_type=file.kind, headers={**headers, "Content-Encoding": "gzip"})
    return Response(file.content, media_type=file.kind, headers=headers)
