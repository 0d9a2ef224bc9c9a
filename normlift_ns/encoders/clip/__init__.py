"""OpenCLIP: features of masked crops and of patches."""
