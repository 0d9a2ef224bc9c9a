"""Encoders with networks of the transformers library, in Hugging Face hub format: SigLIP, SigLIP 2, MetaCLIP 2."""
