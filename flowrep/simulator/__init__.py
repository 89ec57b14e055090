"""A street in PyBullet, which tests collisions and draws pictures, and in a rasteriser for maps."""
