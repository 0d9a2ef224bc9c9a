import json
from pathlib import Path

import numpy as np
from PIL import Image

from normlift_ns.demo.capture import demo_cameras, held_out_cameras, view_image, view_labels, write_capture


def test_images_and_masks_are_the_views_and_labels_name_their_values(tmp_path: Path):
    from tests.plain_room import plain_room  # noqa: PLC0415

    small, folder = plain_room(2000), tmp_path / "room"
    write_capture(small, folder, views=2, held_out=2, width=60, height=44)
    cameras = [*demo_cameras(2, 60, 44), *held_out_cameras(2, 60, 44)]
    for kind, mode, view in (("images", "RGB", view_image), ("instance", "L", view_labels)):
        assert sorted(path.name for path in (folder / kind).iterdir()) == [f"{i:04d}.png" for i in range(4)]
        for i, camera in enumerate(cameras):
            with Image.open(folder / kind / f"{i:04d}.png") as image:
                assert (image.size, image.mode) == ((60, 44), mode)
                assert np.array_equal(np.asarray(image), view(small, camera).numpy())
    names = {str(i): name for i, name in enumerate(small.names, 1)}
    assert json.loads((folder / "labels.json").read_text()) == {"labels": names, "background": 0}
