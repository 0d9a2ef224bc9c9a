"""Several processes that lift one scene together."""
