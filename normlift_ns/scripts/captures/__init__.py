"""Many captures: the list, who does which, a process for each, and what came of them."""
