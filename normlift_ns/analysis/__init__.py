"""Diagnostics of a query: relevancy histograms, votes of images, and floaters."""
