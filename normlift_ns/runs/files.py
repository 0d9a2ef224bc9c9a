"""Where the files of a lifted run are."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterable, Mapping
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from normlift_ns.core.disk.digests import file_digest, text_digest
from normlift_ns.core.disk.manifest import BESIDE, MANIFEST, check_files, read_manifest
from normlift_ns.core.files import clean, refuse_existing
from normlift_ns.errors import InputError

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor

    from normlift_ns.core.field import SemanticField

FIELD_FOLDER = "normlift"
"""Folder of the semantic field inside the run directory."""
TEXTS_FILE = "texts.npz"
"""Texts with vectors of the user's own, in the folder of the field."""
_LONGEST_NAME = 200
"""Bytes of a folder's name; systems take 255, and some are left for numbers."""
_SEAL = "# Lines below: "
"""How a config.yml of ours begins; their digest follows."""


def run_directory(output_dir: Path, name: str, timestamp: str | None = None) -> Path:
    """Where a lifted run goes: output_dir/name/normlift/timestamp, absolute.

    Args:
        timestamp: None: now, as 2024-05-01_120000.
    Raises:
        ValueError: a timestamp or a name that is not the name of one folder.
    """
    stamp = datetime.now().strftime("%Y-%m-%d_%H%M%S") if timestamp is None else timestamp
    for what, folder in (("timestamp", stamp), ("experiment name", name)):
        if not isinstance(folder, str):
            raise InputError(f"the {what} must be a text, got {folder!r:.60}")
        if folder.startswith(".") or folder.strip() == "" or {"/", "\\"} & set(folder) or not folder.isprintable():
            raise InputError(
                f"the {what} {folder!r} is not the name of a folder; give one without slashes, such as 'run'"
            )
        if len(os.fsencode(folder)) > _LONGEST_NAME:
            raise InputError(f"the {what} {folder[:20]!r}… has {len(folder)} characters; give at most {_LONGEST_NAME}")
    return Path(os.path.abspath(output_dir)) / name / "normlift" / stamp


def cache_folder(run_dir: Path) -> Path:
    """Folder of 2D features, evidence and texts, shared by the lifted runs beside each other."""
    return run_dir.parent / ".cache"


def texts_cache(run_dir: Path) -> Path:
    """Folder in which vectors of texts are kept."""
    return cache_folder(run_dir) / "texts"


def field_folder(run_dir: Path) -> Path:
    """The folder of the semantic field of a lifted run.

    Raises:
        FileNotFoundError: the run has none.
    """
    folder = run_dir / FIELD_FOLDER
    if not folder.is_dir():
        raise FileNotFoundError(
            f"{run_dir} is a run without semantics (no {FIELD_FOLDER}/ in it). Lift it with ns-normlift --load-config, "
            "then give the config.yml that ns-normlift names at its end."
        )
    return folder


def load_field(
    run_dir: Path, means: Float[Tensor, "n 3"] | None = None, *, checkpoint: str | Path = "the checkpoint"
) -> SemanticField:
    """The semantic field of a lifted run.

    Args:
        means, checkpoint: as in `SemanticField.load`.
    Raises:
        FileNotFoundError: the run has none.
        ValueError: a damaged field, or one of other Gaussians than the means.
    """
    from normlift_ns.core.field import SemanticField  # noqa: PLC0415 (the commands look at places before torch loads)

    folder = field_folder(run_dir)
    return with_paths(SemanticField.load(folder, means, checkpoint=checkpoint), folder)


def recorded_rules(run_dir: Path) -> str | None:
    """The version of gsplat by whose rules a run was lifted; None: it is no lifted one, or does not say.

    Raises:
        ValueError: the manifest of its semantic field is damaged.
    """
    folder = run_dir / FIELD_FOLDER
    if not (folder / MANIFEST).exists():
        return None
    rules = read_manifest(folder)[0].get("gsplat_rules")
    return None if rules is None else str(rules)


def with_paths(field: SemanticField, folder: Path) -> SemanticField:
    """The field, with `stored_paths`."""
    return replace(field, manifest=stored_paths(field.manifest, folder))


def stored_paths(manifest: Mapping[str, Any], folder: Path) -> Mapping[str, Any]:
    """The manifest, with the file of its texts, which it names as it lies in its folder, by its whole path."""
    encoder = manifest.get("encoder")
    if not isinstance(encoder, dict) or encoder.get("text_vectors") is None:
        return manifest
    path = str(folder / encoder["text_vectors"])  # an absolute one stays
    return {**manifest, "encoder": {**encoder, "text_vectors": path}}


def check_run(run_dir: Path) -> None:
    """Makes sure that the files of a lifted run are as they were written; warns where config.yml is not.

    Raises:
        ValueError: a file that is damaged, or of another run.
    """
    if not run_dir.exists():
        clean(run_dir.parent)  # a lift that was killed while it replaced the run
    _check_seal(run_dir / "config.yml")
    if (run_dir / FIELD_FOLDER / MANIFEST).exists():
        check_files(run_dir / FIELD_FOLDER)


def digests_beside(folder: Path, files: Iterable[Path]) -> dict[str, str]:
    """Digests of files of a run by their paths from the folder of its field; what is elsewhere, or absent, has none."""
    names = {Path(os.path.relpath(file, folder)).as_posix(): file for file in files if file.is_file()}
    return {name: file_digest(file) for name, file in names.items() if BESIDE.fullmatch(name)}


def sealed(config: str) -> str:
    """The text of a config.yml with its digest in a comment at its top, because people may edit it and should know."""
    return f"{_SEAL}{text_digest(config)} (to change them without a warning, delete this line)\n{config}"


def _check_seal(path: Path) -> None:
    if not path.is_file():
        return
    first, _, rest = path.read_bytes().decode("utf8", "replace").replace("\r\n", "\n").partition("\n")
    if first.startswith(_SEAL) and first != sealed(rest).partition("\n")[0]:
        warnings.warn(
            f"{path} is not as normlift_ns wrote it: it was edited, or is damaged. If you changed it, delete its first "
            "line; otherwise copy it again from the whole run",
            stacklevel=3,
        )


def tidy(run_dir: Path) -> None:
    """Completes and removes what lifts that were killed have left beside a run directory and in its cache."""
    for folder in (run_dir.parent, *cache_folder(run_dir).glob("*")):
        clean(folder)


def refuse_existing_run(run_dir: Path, overwrite: bool) -> None:
    """Raises FileExistsError if the directory is there and may not be replaced, or is no run."""
    refuse_existing(run_dir, overwrite=overwrite, instead="--timestamp or --output-dir")
    if os.path.lexists(run_dir) and not (run_dir / "config.yml").is_file():
        raise FileExistsError(
            f"{run_dir} is no run (it has no config.yml), so that --overwrite does not replace it; give another "
            "--timestamp or --output-dir, or remove it yourself"
        )
