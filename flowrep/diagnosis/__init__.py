"""Which convention is wrong: one diagnosis of recordings, environments and replay batches.

A witness tells, for any motion of the camera, how far each pixel is from where the data have it:
raw flow where it was measured, and else the depth of the frame before. The motion that leaves least
is possible with these data; what the recorded one leaves beyond it is the error of a convention,
whether anybody listed that mistake or not. The rivals, a table of the usual mistakes, are then
tried as explanations. What a rival has to learn from the data (a factor, a transform) it learns
from one half of the pairs of frames, and is judged by the other.
"""

from flowrep.diagnosis.envs import diagnose
from flowrep.diagnosis.recordings import Examination
from flowrep.diagnosis.verdict import Diagnosis

__all__ = ["Diagnosis", "Examination", "diagnose"]
