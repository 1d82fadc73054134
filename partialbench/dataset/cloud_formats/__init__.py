"""Formats of point clouds, one a file: content → points (n,3) and, where it has them, normals."""
