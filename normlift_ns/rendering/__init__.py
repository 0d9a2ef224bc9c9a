"""Colors, legends and figures of answers."""
