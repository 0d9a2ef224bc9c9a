"""Analysis of a lifted run: objects, catalogs, explanations and vote records."""
