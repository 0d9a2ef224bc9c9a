"""Analysis of a lifted run: objects and their catalogue, and explanations of selections."""
