"""Readers and writers for nerfstudio's splatfacto runs, mostly without importing nerfstudio."""
