"""Registration of the environments with `gymnasium.make`."""

import gymnasium

SCENE_BY_ID = {
    "flowrep/StraightRoad-v0": "straight_road",
    "flowrep/STurn-v0": "s_turn",
    "flowrep/HShapedPathways-v0": "h_shaped_pathways",
    "flowrep/ThreeWayJunction-v0": "three_way_junction",
}


def register_environments() -> None:
    """Registers every environment of the package with gymnasium."""
    for name, scene in SCENE_BY_ID.items():
        gymnasium.register(
            name, entry_point="flowrep.envs.represented:make_street", kwargs={"scene": scene}
        )
