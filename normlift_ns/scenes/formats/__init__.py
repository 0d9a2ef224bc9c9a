"""File formats of splats."""
