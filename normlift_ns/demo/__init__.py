"""The demo room, a small synthetic scene with ground truth: tensors, a nerfstudio dataset and a trained run."""
