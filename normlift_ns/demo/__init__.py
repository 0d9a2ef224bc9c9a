"""The demo room, a small synthetic scene with ground truth: tensors, a nerfstudio dataset and a trained run."""

from normlift_ns.demo.capture import (
    demo_cameras,
    held_out_cameras,
    view_image,
    view_labels,
    write_capture,
    write_splatfacto_run,
)
from normlift_ns.demo.room import DemoRoom, demo_room

__all__ = [
    "DemoRoom",
    "demo_cameras",
    "demo_room",
    "held_out_cameras",
    "view_image",
    "view_labels",
    "write_capture",
    "write_splatfacto_run",
]
