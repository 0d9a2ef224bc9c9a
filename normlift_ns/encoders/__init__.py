"""2D features of images and text embeddings in one space. Imports nothing, so that `encoders.registry` can be imported
without torch."""
