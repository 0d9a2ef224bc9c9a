"""What a viewer shows of a field, whichever viewer it is."""
