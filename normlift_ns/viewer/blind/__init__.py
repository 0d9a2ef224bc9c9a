"""Browsers without WebGL: how viser's page lives in them, and the pictures that they get."""
