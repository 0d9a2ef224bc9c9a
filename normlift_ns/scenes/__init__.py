"""Trained splats from anywhere, and the photographs that they were trained with, as a `Scene` of the core."""
