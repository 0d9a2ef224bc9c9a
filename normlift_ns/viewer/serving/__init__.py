"""How pages are served: the door where they wait, and what is served at all."""
