"""GPU kernels in Triton, which torch brings along: functions on plain tensors, without the rest of this package."""
