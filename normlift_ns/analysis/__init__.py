"""Analysis of a lifted run: objects, catalogs, inventories, floaters and explanations of selections."""
