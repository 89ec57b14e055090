"""Which convention is wrong: one diagnosis of recordings, environments and replay batches.

For any motion of the camera, a witness says how far each pixel is from where the data have it: raw
flow where it was measured or estimated, else the depth of the frame before. The motion that leaves
least is possible with these data. What the recorded motion leaves beyond it is the error of a
convention, listed or not. The rivals, a table of the usual mistakes, are then tried as
explanations. Numbers that a rival needs (a factor, a transform) are fitted to one half of the pairs
of frames and judged by the other.
"""

from flowrep.diagnosis.envs import diagnose
from flowrep.diagnosis.recordings import Examination
from flowrep.diagnosis.verdict import Diagnosis

__all__ = ["Diagnosis", "Examination", "diagnose"]
