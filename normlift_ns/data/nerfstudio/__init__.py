"""Readers and writers for nerfstudio's splatfacto runs, mostly without an import of nerfstudio."""
