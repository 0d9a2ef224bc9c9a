"""Networks of the SAM family, their automatic masks, and label maps."""
