"""Readers that load a trained splat and its training images as a `core.scene.Scene`."""
