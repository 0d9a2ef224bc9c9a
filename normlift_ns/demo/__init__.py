"""Demo room: a small synthetic scene with ground truth, as tensors, as a nerfstudio dataset and as a trained run."""
