"""What a lift will take: from a short look at a capture on this machine to seconds, memory and disk."""
