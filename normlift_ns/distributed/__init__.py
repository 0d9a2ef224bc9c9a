"""Distributed lifting: several processes lift one scene together."""
