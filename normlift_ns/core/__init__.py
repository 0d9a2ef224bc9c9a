"""Implementation of the method on plain tensors, independent of nerfstudio."""
