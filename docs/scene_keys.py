"""Writes what editors and docs/scenes.md say about the keys of a scene, from their docstrings."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest.mock import patch

from pydantic import TypeAdapter

from flowrep.scenes.scene import Part, Scene

PAGE, SCHEMA = (Path(__file__).parent / name for name in ("scenes.md", "scene.schema.json"))
MARKS = "<!-- make schema: -->\n", "<!-- end -->\n"


def schema() -> dict[str, Any]:
    """Returns the JSON schema of scene files."""
    # Not always, because reading the docstrings takes 0.15 s.
    with patch.dict(Part.__pydantic_config__, use_attribute_docstrings=True):
        plain = _without_titles(TypeAdapter(Scene).json_schema())
    return plain | {"$schema": "https://json-schema.org/draft/2020-12/schema"}


def _without_titles(node: Any) -> Any:  # which repeat the keys
    if isinstance(node, list):
        return [_without_titles(each) for each in node]
    if not isinstance(node, dict):
        return node
    return {key: _without_titles(value) for key, value in node.items() if key != "title"}


def lines(node: Any, depth: int = 4, indent: str = "") -> str:
    """Returns JSON in which a key of a scene, `depth` below the whole, is a line."""
    if depth == 0 or not isinstance(node, dict):
        return json.dumps(node, ensure_ascii=False)
    inner = indent + " "
    parts = [f"{inner}{json.dumps(k)}: {lines(node[k], depth - 1, inner)}" for k in node]
    return "{\n" + ",\n".join(parts) + f"\n{indent}}}"


def rows(part: dict[str, Any], parts: dict[str, Any], prefix: str = "") -> Iterator[str]:
    """Yields a row of the page's table for each key, with those within it below."""
    for key, field in part["properties"].items():
        inner = next((name for name in parts if f"/{name}'" in str(field)), None)
        described = (parts[inner] if inner else field)["description"]
        yield f"| `{prefix}{key}` | {' '.join(described.split())} |\n"
        if inner:
            yield from rows(parts[inner], parts, f"{prefix}{key}.")


def page(text: str) -> str:
    """Returns the page with the table between its marks."""
    before, _, rest = text.partition(MARKS[0])
    after = rest.partition(MARKS[1])[2]
    whole = schema()
    table = "".join(["\n| key | meaning |\n| --- | --- |\n", *rows(whole, whole["$defs"]), "\n"])
    return before + MARKS[0] + table + MARKS[1] + after


if __name__ == "__main__":
    SCHEMA.write_text(lines(schema()) + "\n", "utf-8")
    PAGE.write_text(page(PAGE.read_text("utf-8")), "utf-8")
