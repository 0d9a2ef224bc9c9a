"""README for a package index, where links into this repository need its address. All else is in pyproject.toml."""

import re
from pathlib import Path

from setuptools import setup

FILES = "https://github.com/normlift-ns/normlift_ns/blob/main/"
README = (Path(__file__).parent / "README.md").read_text("utf8")
PICTURES = re.sub(r"(!\[[^\]]*\])\((?!https:)([^)]+)\)", rf"\1({FILES}\2?raw=true)", README)

setup(
    long_description=re.sub(r"\]\((?!https:|#)([^)]+)\)", rf"]({FILES}\1)", PICTURES),
    long_description_content_type="text/markdown",
)
