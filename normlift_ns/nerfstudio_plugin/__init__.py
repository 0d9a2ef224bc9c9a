"""All that knows nerfstudio: its runs, its model, its viewer."""
