"""Analysis of a lifted run: objects and their catalog, and explanations of selections."""
