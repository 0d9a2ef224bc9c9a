"""Atomic file operations, data files with digests, work claims, and checks of files and memory."""
