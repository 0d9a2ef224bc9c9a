"""Module paths of commands in earlier versions."""
