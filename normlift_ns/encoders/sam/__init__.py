"""SAM's automatic masks, and the rules that make label maps of them."""
