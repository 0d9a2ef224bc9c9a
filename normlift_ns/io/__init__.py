"""Atomic file operations, data files with digests, and memory limits."""
