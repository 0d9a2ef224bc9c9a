"""Parts of the panel in nerfstudio's viewer: adapter for viser, widgets and controller."""
