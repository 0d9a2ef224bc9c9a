"""Method specifications of nerfstudio, which find the plugin by the entry points that name them."""
