"""Pictures of representations, fixed in colour and scale; `flowrep.viz.plan` draws scenes."""

from flowrep.viz.maps import (
    CLASS_COLOURS,
    DEPTH_RANGE_M,
    FLOW_SCALE_PX,
    OUTCOME_COLOURS,
    Image,
    Tile,
    classes_to_rgb,
    contact_sheet,
    depth_note,
    depth_to_rgb,
    flow_note,
    flow_to_rgb,
    flow_wheel,
    grey_to_rgb,
    representation_strip,
    stock_tiles,
    strip,
    write_png,
)
from flowrep.viz.video import Video, write_video

__all__ = [
    "CLASS_COLOURS", "DEPTH_RANGE_M", "FLOW_SCALE_PX", "OUTCOME_COLOURS", "Image", "Tile", "Video",
    "classes_to_rgb", "contact_sheet",
    "depth_note", "depth_to_rgb", "flow_note", "flow_to_rgb", "flow_wheel", "grey_to_rgb",
    "representation_strip", "stock_tiles", "strip", "write_png", "write_video",
]  # fmt: skip
