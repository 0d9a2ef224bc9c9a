"""Text embeddings without torch: color names, files of embeddings, and a cache of earlier prompts."""
