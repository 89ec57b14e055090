"""Which convention is wrong: one diagnosis of recordings, environments and replay batches.

A camera motion predicts where each pixel was in the previous frame. The prediction is compared with
a reference: raw flow if it was measured or estimated, else the depth of the previous frame. The
motion with the smallest residuals shows how well the data can agree. If the residuals of the
recorded motion are larger, a convention is wrong, whether the table of usual mistakes (the rivals)
lists it or not. The rivals are then tried as explanations. Numbers that a rival needs (a factor, a
transform) are fitted to one half of the pairs of frames and judged by the other.
"""

from flowrep.diagnosis.envs import diagnose
from flowrep.diagnosis.recordings import Examination
from flowrep.diagnosis.verdict import Diagnosis

__all__ = ["Diagnosis", "Examination", "diagnose"]
