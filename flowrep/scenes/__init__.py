"""Scenes: streets described in YAML and laid out on the ground, without a simulator."""

from flowrep.extras import require

require("flowrep.scenes", "sim", "shapely", "yaml", "pydantic")

from flowrep.scenes.load import load_scene, scene_names  # noqa: E402 - after the check above
from flowrep.scenes.scene import CATEGORY_ID, Scene, SceneError  # noqa: E402

__all__ = ["CATEGORY_ID", "Scene", "SceneError", "load_scene", "scene_names"]
