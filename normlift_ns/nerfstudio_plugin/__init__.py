"""Integration with nerfstudio: configs, model, pipeline and viewer panel."""
