"""Coverage study: regions without reliable evidence, unused images that would help, and new poses."""
