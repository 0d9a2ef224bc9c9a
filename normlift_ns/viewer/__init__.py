"""Web viewer, and the parts that it shares with the panel in nerfstudio's viewer."""
