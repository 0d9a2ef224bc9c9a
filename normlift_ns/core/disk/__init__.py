"""Files on a disk: in one step, with digests."""
