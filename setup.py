"""Command that builds the web page, and the README for a package index, where links need this repository's address.

All else is in pyproject.toml.
"""

import re
import sys
from pathlib import Path

from setuptools import setup

sys.path.insert(0, str(Path(__file__).parent / "web"))

from backend import BuildPage

FILES = "https://github.com/normlift-ns/normlift_ns/blob/main/"
README = (Path(__file__).parent / "README.md").read_text("utf8")
PICTURES = re.sub(r"(!\[[^\]]*\])\((?!https:)([^)]+)\)", rf"\1({FILES}\2?raw=true)", README)

setup(
    cmdclass={"build_page": BuildPage},
    long_description=re.sub(r"\]\((?!https:|#)([^)]+)\)", rf"]({FILES}\1)", PICTURES),
    long_description_content_type="text/markdown",
)
