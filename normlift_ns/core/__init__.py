"""The method on tensors: needs torch, numpy, scipy and safetensors, and knows nothing of nerfstudio."""
