"""Where to look next: regions without reliable evidence, photographs that were left out and would help, new poses."""
