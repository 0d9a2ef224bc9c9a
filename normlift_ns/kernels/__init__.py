"""Triton kernels for GPUs, as functions of plain tensors that do not use the rest of this package."""
