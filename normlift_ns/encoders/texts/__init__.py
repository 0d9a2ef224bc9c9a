"""Vectors of texts without torch: colour names, files of vectors, and texts that a network has read before."""
