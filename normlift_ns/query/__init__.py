"""Queries of a semantic field: prompts, relevancy, thresholds and answers."""
