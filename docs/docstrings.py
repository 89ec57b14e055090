"""Prepares docstrings for the site: fences doctests, and links the names of the public API."""

import ast
import re
from pathlib import Path

import griffe

PACKAGE = Path(__file__).parents[1] / "flowrep"
_DOCTEST = re.compile(r"^([ \t]*)>>> .*\n?(?:^\1\S.*\n?)*", re.MULTILINE)
_FENCE = re.compile(r"(^[ \t]*```.*?^[ \t]*```\n)", re.MULTILINE | re.DOTALL)
_PAGE = re.compile(r"(?<![\w/`])docs/(\w+)\.md")
_NAME = re.compile(r"(?<![`\[])`([A-Za-z_][\w.]*)(?:\(\))?`(?!`)")


def fenced(docstring: str) -> str:
    """Returns the docstring with a code fence around every block that begins with >>>."""

    def fence(block: re.Match[str]) -> str:
        indent = block.group(1)
        return f"{indent}```python\n{block.group(0).rstrip()}\n{indent}```\n"

    return _DOCTEST.sub(fence, docstring)


def public_names(package: Path = PACKAGE) -> dict[str, str]:
    """Returns the full name of what each package of flowrep exports, by its name."""
    found = {}
    for init in sorted(package.glob("*/__init__.py")):
        module = f"flowrep.{init.parent.name}"
        for statement in ast.parse(init.read_text(encoding="utf-8")).body:
            match statement:
                case ast.Assign(targets=[ast.Name(id="__all__")], value=value):
                    found |= {name: f"{module}.{name}" for name in ast.literal_eval(value)}
    return found


def linked(docstring: str, names: dict[str, str], own: str = "") -> str:
    """Returns the docstring with links: names in backticks that are public, and pages of docs/.

    A name without an entry in the reference stays text, and so does `own`.
    """

    def link(span: re.Match[str]) -> str:
        first, _, rest = span.group(1).partition(".")
        target = names.get(first, first) + (f".{rest}" if rest else "")
        if not target.startswith("flowrep.") or target == own:
            return span.group(0)
        return f'<autoref optional identifier="{target}">{span.group(0)}</autoref>'

    parts = _FENCE.split(docstring)  # every second one is a fence
    for n in range(0, len(parts), 2):
        # pages of the reference lie two folders deep
        parts[n] = _PAGE.sub(r"[\g<0>](../../\1/)", _NAME.sub(link, parts[n]))
    return "".join(parts)


class Docstrings(griffe.Extension):
    """Goes through every object's docstring."""

    names = public_names()

    def on_object(self, *, obj: griffe.Object, **kwargs: object) -> None:
        """Prepares the docstring of an object once it is known."""
        if obj.docstring is not None:
            own = self.names.get(obj.name, "")
            obj.docstring.value = linked(fenced(obj.docstring.value), self.names, own)
