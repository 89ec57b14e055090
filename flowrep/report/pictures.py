"""Figures and films as data URIs, for embedding in a page."""

import base64
import io
from pathlib import Path

from matplotlib.figure import Figure

from flowrep.report.style import saving


def svg_uri(figure: Figure) -> str:
    """Returns a figure as a data URI of an SVG; the same figure gives the same text."""
    data = io.BytesIO()
    with saving():
        figure.savefig(data, format="svg", metadata={"Date": None})
    return _uri("image/svg+xml", data.getvalue())


def png_uri(figure: Figure, dpi: int) -> str:
    """Returns a figure as a data URI of a PNG."""
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=dpi)
    return _uri("image/png", data.getvalue())


def film_uri(path: Path) -> str:
    """Returns an mp4 file as a data URI."""
    return _uri("video/mp4", path.read_bytes())


def _uri(kind: str, data: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(data).decode('ascii')}"
