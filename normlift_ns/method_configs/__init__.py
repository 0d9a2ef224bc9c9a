"""nerfstudio method specifications, which nerfstudio finds through entry points."""
