"""Mesh files: one reader a format, polygons cut into triangles, and a count beside each reader."""
