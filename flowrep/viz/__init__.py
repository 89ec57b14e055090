"""Pictures of representations, fixed in colour and scale; `flowrep.viz.plan` draws scenes."""

from flowrep.viz.maps import (
    DEPTH_RANGE_M,
    FLOW_SCALE_PX,
    Image,
    Video,
    classes_to_rgb,
    contact_sheet,
    depth_bar,
    depth_to_rgb,
    flow_note,
    flow_to_rgb,
    flow_wheel,
    representation_strip,
    strip,
    write_png,
    write_video,
)

__all__ = [
    "DEPTH_RANGE_M", "FLOW_SCALE_PX", "Image", "Video", "classes_to_rgb", "contact_sheet",
    "depth_bar", "depth_to_rgb", "flow_note", "flow_to_rgb", "flow_wheel", "representation_strip",
    "strip", "write_png", "write_video",
]  # fmt: skip
