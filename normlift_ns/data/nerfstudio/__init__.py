"""nerfstudio's splatfacto runs, read and written without importing nerfstudio."""
