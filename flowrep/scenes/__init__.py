"""Scenes: what a street is, read from YAML and laid out on the ground, without any simulator."""

from flowrep.extras import require

require("flowrep.scenes", "sim", "shapely", "yaml", "pydantic")

from flowrep.scenes.loading import load_scene, scene_names  # noqa: E402 - after what it needs
from flowrep.scenes.scene import Scene  # noqa: E402
from flowrep.scenes.schema import SceneError  # noqa: E402

__all__ = ["Scene", "SceneError", "load_scene", "scene_names"]
