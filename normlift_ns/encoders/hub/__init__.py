"""Networks of the transformers library, in the format of the Hugging Face hub: SigLIP, SigLIP 2, MetaCLIP 2."""
