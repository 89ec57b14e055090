"""The limits that the diagnosis decides by, each with its unit and its reason."""

from __future__ import annotations

# Errors of flow, and what estimated flow is wrong by on any surface: px, and share of its length.
HARMLESS = 0.05, 0.05
MATTERS = 3.0  # times that: a common error of which right data may not be suspected
# Of measured flow: data are rounded.
ROUNDED = 0.01, 0.005
NOISE = 3.0  # times noise: what is below may be noise
REST_PX = 0.25  # of flow: with less, a camera or a body is at rest
MOST_NOISE = 0.25  # of flow's length: a larger error isn't taken for noise of sensors
# Of what is left of depth as recorded: another motion leaves as much by noise that pixels share.
ALIKE_LEFT = 0.85

# Nats that an explanation has to be better by: 15 are the odds of a hundred thousand to one for one
# of fifty mistakes; noise that pixels share doubles what chance gives.
SURE = 25.0
PAIR = 10.0  # nats at most that a pair counts for or against an explanation, of few pairs more
ALIKE = 3.0  # nats, twenty to one: explanations whose scores differ by less are alike

FEW = 3  # frames or pairs: fewer may show anything by chance; and explanations that are told
MANY = 0.2  # of all pairs or pixels: they matter
BODY = 0.03  # of a pair's pixels: a motion of fewer may be chance
FEW_PIXELS = 32  # of a body, of a pair twice as many: fewer tell nothing
PAIRS = 12  # of an env that are tested at most, to save time
