"""Segmentation of images by networks of the SAM family, learned edges, superpixels, grids and label maps."""
