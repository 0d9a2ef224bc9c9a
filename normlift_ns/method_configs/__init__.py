"""nerfstudio method specifications, discovered through entry points."""
