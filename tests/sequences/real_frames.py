"""Four frames of 7-Scenes that lie beside the checkout; tests that use them skip without."""

from __future__ import annotations

from pathlib import Path

import pytest

from flowrep.sequences import SevenScenes

PLACES = [parent / "shared/data/7scenes" for parent in Path(__file__).resolve().parents]
FOLDER = next((place for place in PLACES if place.is_dir()), None)
needs_7scenes = pytest.mark.skipif(
    FOLDER is None, reason="no frames of 7-Scenes in shared/data/7scenes beside the checkout"
)


def seven_scenes() -> SevenScenes:
    return SevenScenes(FOLDER)
