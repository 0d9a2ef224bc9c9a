"""Model, pipeline and viewer panel for nerfstudio."""
