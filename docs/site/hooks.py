"""What the site has that docs/ has not: README as its first page, and the HTTP API out of openapi.json."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

REPOSITORY = Path(__file__).resolve().parents[2]
TO_DOCS = re.compile(r"\]\(docs/")
BESIDE = re.compile(r"\[([^\]]*)\]\((?:\.\./)*(?!docs/)(?:[A-Z]+\.md|LICENSE|docker/[^)]*|examples/[^)]*)\)")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    readme = (REPOSITORY / "README.md").read_text()
    files.append(File.generated(config, "index.md", content=TO_DOCS.sub("](", readme)))
    described = json.loads((REPOSITORY / "openapi.json").read_text())
    files.append(File.generated(config, "site/api.md", content="\n".join(api(described))))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Files of the repository that the site does not have are named, not linked."""
    return BESIDE.sub(r"\1", markdown)


def api(described: dict[str, Any]) -> Iterator[str]:
    """The lines of a page: every route, what it takes and what it answers."""
    yield f"# The HTTP API\n\n{described['info']['description']}\n"
    yield "A running server shows the same at `/docs`, where each request can be tried.\n"
    for path, methods in described["paths"].items():
        for method, operation in methods.items():
            said = operation.get("description", "")
            yield f"## {operation['summary']}\n\n`{method.upper()} {path}`\n\n{said}\n"
            body = _schema(described, operation.get("requestBody", {}))
            if body:
                yield from _table("It takes", body)
            for status in ("200", "201", "202"):
                answer = _schema(described, operation["responses"].get(status, {}))
                if answer:
                    yield from _table(f"It answers, with {status}", answer)
            refused = {s: told for s, told in operation["responses"].items() if s >= "300"}
            if refused:
                yield "\n| status | when |\n|---|---|"
                yield from (
                    f"| {status} | {_line(told['description'])} |" for status, told in refused.items()
                )
                yield ""


def _schema(described: dict[str, Any], part: dict[str, Any]) -> dict[str, Any]:
    schema = part.get("content", {}).get("application/json", {}).get("schema", {})
    return _resolved(described, schema) if "$ref" in schema else {}


def _resolved(described: dict[str, Any], schema: dict[str, Any]) -> dict[str, Any]:
    found: dict[str, Any] = described["components"]["schemas"][schema["$ref"].rpartition("/")[2]]
    return found


def _table(title: str, schema: dict[str, Any]) -> Iterator[str]:
    members = schema.get("properties", {})
    if not members:
        return
    needed = schema.get("required", [])
    yield f"\n**{title}**\n\n| member | | what it is |\n|---|---|---|"
    for name, told in members.items():
        kind = "required" if name in needed and title == "It takes" else ""
        yield f"| `{name}` | {kind} | {_line(told.get('description', ''))} |"
    yield ""


def _line(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")
