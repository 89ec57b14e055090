"""Which convention is wrong: one diagnosis of recordings, environments and replay batches.

A camera motion predicts where each pixel was in the previous frame. The prediction is compared with
a reference: raw flow if it was measured or estimated, else the depth of the previous frame. The
data as recorded compete with the same data after each usual mistake is undone, by one likelihood.

`recordings` and `envs` make pairs of frames (`fit`). `mistakes` lists the mistakes, `candidates`
fits their numbers, `pictures` says what pairs show, `poses` how well recorded motions fit that,
`explanation` scores both, `competition` has all explanations, and `verdict` says what follows.
`limits` has what they decide by.
"""

from flowrep.diagnosis.envs import diagnose
from flowrep.diagnosis.recordings import Examination
from flowrep.diagnosis.verdict import Diagnosis

__all__ = ["Diagnosis", "Examination", "diagnose"]
