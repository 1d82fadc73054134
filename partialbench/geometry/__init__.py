"""Pure NumPy geometry: rotations, cameras, symmetries. No torch, no I/O."""
