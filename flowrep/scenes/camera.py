"""The camera on the vehicle, as a scene describes it."""

import math
from dataclasses import dataclass

from flowrep.scenes.fields import FieldOfView, Length, Part, Pitch, Pixels, Place, Size


@dataclass(frozen=True)
class CameraConfig(Part):
    """A camera on the vehicle: `fov_deg` is vertical, `pitch_deg` is positive upwards."""

    height_px: Pixels
    width_px: Pixels
    fov_deg: FieldOfView
    mount_height_m: Size
    mount_forward_m: Place
    pitch_deg: Pitch
    near_m: Length
    far_m: Length

    @property
    def focal_px(self) -> float:
        """The focal length in pixels, the same along both axes."""
        return 0.5 * self.height_px / math.tan(math.radians(self.fov_deg) / 2)
