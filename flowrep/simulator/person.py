"""A person as low-polygon meshes, one for each rigid part."""

from flowrep.scenes.people import HIP_M, PARTS
from flowrep.simulator.meshes import Mesh
from flowrep.simulator.paint import SHIRTS, swatch


def person_meshes(variant: int) -> tuple[Mesh, ...]:
    """Returns the meshes of a person's `PARTS`, facing along x; `variant` selects the shirt.

    Seen from the side, as a vehicle sees people crossing, the arms alone span 0.6 m. The origin of
    a leg is its hip.
    """
    shirt, skin = swatch(SHIRTS[variant % len(SHIRTS)]), swatch("skin")
    body = Mesh()
    for side, arm in ((-1, 0.19), (1, -0.19)):
        y = 0.26 * side
        body.box((arm - 0.11, y - 0.05, 0.95), (arm + 0.11, y + 0.05, 1.35), shirt)
        body.box((arm - 0.05, y - 0.05, 0.85), (arm + 0.11, y + 0.05, 0.95), skin, lid=False)
    body.box((-0.14, -0.21, 0.8), (0.14, 0.21, 1.47), shirt)
    body.box((-0.11, -0.1, 1.47), (0.12, 0.1, 1.68), skin, lid=False)
    body.box((-0.13, -0.11, 1.62), (0.12, 0.11, 1.75), swatch("hair"))
    legs = []
    for _ in PARTS[1:]:
        leg = Mesh()
        leg.box((-0.1, -0.08, -HIP_M + 0.1), (0.1, 0.08, 0.02), swatch("trousers"), lid=False)
        leg.box((-0.1, -0.08, -HIP_M), (0.2, 0.08, -HIP_M + 0.1), swatch("shoe"))
        legs.append(leg)
    return (body, *legs)
