"""Formats of files that hold a splat."""
