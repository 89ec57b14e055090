"""Writes the schema from which editors show the keys of a scene, made of their docstrings."""

import json
from pathlib import Path
from typing import Any
from unittest.mock import patch

from pydantic import TypeAdapter

from flowrep.scenes.scene import Part, Scene

SCHEMA = Path(__file__).parent / "scene.schema.json"


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


if __name__ == "__main__":
    SCHEMA.write_text(lines(schema()) + "\n", "utf-8")
