"""A street as bodies: PyBullet tests collisions, a rasteriser draws what cameras see."""
