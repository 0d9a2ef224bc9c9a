"""Runs of nerfstudio's splatfacto, read and written without importing nerfstudio."""
