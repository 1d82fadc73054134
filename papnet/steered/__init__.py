"""PAPNet's idea without a grid: a steerable descriptor, scored jointly over poses and classes."""
