"""The demo room, a small synthetic scene with ground truth, as tensors, a nerfstudio dataset and a trained run."""
