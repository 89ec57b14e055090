"""What a camera sees of rigid bodies made of triangles: depth and ids, drawn without PyBullet."""
