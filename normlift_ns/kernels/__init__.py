"""GPU kernels in Triton, which torch brings along: functions on plain tensors that know nothing else of this package."""
