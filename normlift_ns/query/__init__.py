"""Queries of a semantic field: prompts, relevancies, thresholds and answers."""
