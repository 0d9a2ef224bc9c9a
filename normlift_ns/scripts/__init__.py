"""Old paths of the commands."""
