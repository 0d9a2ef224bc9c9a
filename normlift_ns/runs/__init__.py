"""Files of a lifted run."""
