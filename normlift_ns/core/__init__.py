"""The method on plain tensors. It needs torch, numpy, scipy and safetensors, but not nerfstudio."""
