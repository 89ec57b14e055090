"""The files of a factorisation: flow, pictures and frames of the video."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from flowrep.sequences.factorization import FactorizedFrame
from flowrep.sequences.flow_files import write_flo, write_kitti_flow
from flowrep.viz import Image, flow_note, representation_strip, strip
from flowrep.viz import flow_to_rgb as colours_of

FLOW_FORMATS = ("flo", "kitti", "npz")
FLOW_NAMES = ("raw", "ego", "obj")


@dataclass(frozen=True)
class OutputOptions:
    """The outputs to write.

    Attributes:
        flow_files: formats of flow files, from `FLOW_FORMATS`.
        pictures_every: the number of frames from one set of flow pictures to the next; 0 for none.
        scale_px: the flow of full colour by name, pixels.
        depth_range_m: the depth at which the video's colours end, metres.
    """

    flow_files: Sequence[str] = ("flo",)
    pictures_every: int = 10
    scale_px: Mapping[str, float] = field(default_factory=lambda: dict.fromkeys(FLOW_NAMES, 20.0))
    depth_range_m: float = 10.0


def write_frame(
    folder: Path, index: int, factorized: FactorizedFrame, options: OutputOptions
) -> None:
    """Writes the files of one frame.

    ```
    flow/<raw, ego, obj>/<name>.flo      and / or .png, KITTI's
    flow/<name>.npz                      raw, ego, obj, valid, ego_valid, K, prev_from_curr
    pictures/<raw, ego, obj>/<name>.png  colours, with the scale and the wheel
    ```
    """
    name = factorized.frame.name
    for kind in FLOW_NAMES:
        flow, valid = getattr(factorized, kind), known(kind, factorized)
        if "flo" in options.flow_files:
            write_flo(_place(folder, f"flow/{kind}", f"{name}.flo"), flow, valid)
        if "kitti" in options.flow_files:
            write_kitti_flow(_place(folder, f"flow/{kind}", f"{name}.png"), flow, valid)
        if options.pictures_every and index % options.pictures_every == 0:
            picture = flow_picture(kind, factorized, options.scale_px[kind])
            write_picture(_place(folder, f"pictures/{kind}", f"{name}.png"), picture)
    if "npz" in options.flow_files:
        contents: Any = arrays(factorized)
        np.savez(_place(folder, "flow", f"{name}.npz"), **contents)


def known(kind: str, factorized: FactorizedFrame) -> NDArray[np.bool_]:
    """Returns where a flow is known: obj needs raw and ego."""
    if kind == "raw":
        return np.isfinite(factorized.raw[0]) & np.isfinite(factorized.raw[1])
    return factorized.ego_valid if kind == "ego" else factorized.valid


def arrays(factorized: FactorizedFrame) -> dict[str, NDArray[Any]]:
    """Returns the content of a .npz file."""
    previous, current = factorized.previous, factorized.frame
    return {
        "raw": factorized.raw,
        "ego": factorized.ego,
        "obj": factorized.obj,
        "valid": factorized.valid,
        "ego_valid": factorized.ego_valid,
        "K": current.K,
        "prev_from_curr": np.linalg.inv(previous.world_from_cam) @ current.world_from_cam,
    }


def flow_picture(kind: str, factorized: FactorizedFrame, scale_px: float) -> Image:
    """Returns a flow's colours under a label with the scale and the wheel; unknown is grey."""
    label = f"{kind} flow"
    colours = colours_of(shown(kind, factorized), scale_px)
    return strip({label: colours}, wheel_for=[label], notes={label: flow_note(scale_px)})


def shown(kind: str, factorized: FactorizedFrame) -> NDArray[np.float32]:
    """Returns a flow with nan, which is drawn in grey, where it is unknown."""
    flow = getattr(factorized, kind)
    return np.where(known(kind, factorized), flow, np.float32(np.nan))


def video_frame(factorized: FactorizedFrame, options: OutputOptions) -> Image:
    """Returns RGB, depth, raw, ego and obj side by side."""
    frame = factorized.frame
    maps: dict[str, Any] = {"depth": frame.depth[None]}
    if frame.rgb is not None:
        maps["rgb"] = np.moveaxis(frame.rgb, -1, 0)
    maps |= {kind: shown(kind, factorized) for kind in FLOW_NAMES}
    return representation_strip(
        maps, flow_scale_px=options.scale_px, depth_range_m=options.depth_range_m
    )


def write_picture(path: Path, image: Image) -> None:
    """Writes a picture as a PNG with fast rather than strong compression."""
    whole, data = cv2.imencode(".png", image[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 1])
    if not whole:
        raise OSError(f"{path}: OpenCV can't encode it")
    path.write_bytes(data.tobytes())


def _place(folder: Path, kind: str, name: str) -> Path:
    (folder / kind).mkdir(parents=True, exist_ok=True)
    return folder / kind / name
