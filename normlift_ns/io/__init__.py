"""Atomic file operations and checksummed data files."""
