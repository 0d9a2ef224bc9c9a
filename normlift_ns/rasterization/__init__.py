"""Rasterization with the compositing weights of the rasterizer that trained the scene."""
