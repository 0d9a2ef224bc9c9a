"""Distributed lifting of one scene by several processes."""
