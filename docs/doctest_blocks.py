"""Fences the doctests of docstrings, which griffe would otherwise read as prose."""

import re

import griffe

_DOCTEST = re.compile(r"^([ \t]*)>>> .*\n?(?:^\1\S.*\n?)*", re.MULTILINE)


def fenced(docstring: str) -> str:
    """Returns the docstring with a code fence around every block that begins with >>>."""

    def fence(block: re.Match[str]) -> str:
        indent = block.group(1)
        return f"{indent}```python\n{block.group(0).rstrip()}\n{indent}```\n"

    return _DOCTEST.sub(fence, docstring)


class DoctestBlocks(griffe.Extension):
    """Goes through every object's docstring."""

    def on_object(self, *, obj: griffe.Object, **kwargs: object) -> None:
        """Fences the docstring of an object once it is known."""
        if obj.docstring is not None:
            obj.docstring.value = fenced(obj.docstring.value)
