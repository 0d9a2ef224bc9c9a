"""The method on plain tensors, built on torch, numpy, scipy and safetensors; nerfstudio is not needed."""
