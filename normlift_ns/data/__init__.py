"""Readers of trained splats and their training images, which make them available as a `core.scene.Scene`."""
