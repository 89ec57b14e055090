"""A street as bodies and triangles: collisions and pictures by PyBullet, maps by a rasteriser."""
