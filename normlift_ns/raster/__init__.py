"""Compositing weights as the rasterizer that trained the scene gives them."""
