"""Licenses of the packages that pyproject.toml names, and of weights and words: python -m research.licences"""

from __future__ import annotations

import re
import sys
from importlib.metadata import PackageNotFoundError, metadata, requires
from pathlib import Path

from normlift_ns.cli.weights import WEIGHTS

PAGE = Path(__file__).parents[1] / "docs" / "licences.md"
_CLASSIFIER = "License :: OSI Approved :: "
_USES = {
    "": "always",
    "sam": "extra `sam`",
    "siglip": "extra `siglip`",
    "imagenet": "extra `imagenet`",
    "mcp": "extra `mcp`",
    "dev": "development",
}
_UNSTATED = {"gsplat": "Apache-2.0", "segment-anything": "Apache-2.0", "tomli": "MIT"}
"""Licenses according to the repositories of packages without license metadata, or that are not installed everywhere."""
_SHORT = 60
HEAD = """# Licences

normlift_ns is under the Apache License 2.0. It contains no code of the packages below; pip installs them beside it,
each under its own licence, here as the package states it. Weights and words have licences of their own, below. This
page is made of what is installed: `python -m research.licences`. The web page that wheels contain is built of Spark
2.2.0, three.js 0.187.0 and fflate (all MIT); `normlift_ns/page/assets/licenses.txt` holds their licenses in full.

| package | licence | needed |
|---|---|---|
"""


WEIGHTS_HEAD = """
## Weights

normlift_ns contains no weights. `ns-normlift-weights` lists them and `--get` fetches them from their publishers. Their
licences are those that the publishers state. Whether terms of training data bind those who use the weights is a
question of law that this page cannot answer.

"""
WORDS = """
## Words

`normlift_ns/encoders/imagenet_words.json`, the words that `--encoder imagenet` understands, is made from
[WordNet 3.0](https://wordnet.princeton.edu) by `research/imagenet_words.py`. WordNet is copyright 2006 by Princeton
University, and the file holds its license in full: use, copies, changes and distribution are free for any purpose, with
the notice kept and without use of Princeton's name in advertising. `normlift_ns/encoders/xkcd.json` has the names of
the [XKCD color survey](https://xkcd.com/color/rgb/), which are in the public domain (CC0).
"""
PICTURES = """
## Pictures

All pictures of the documentation are made by scripts of this repository, and are under its license, with one
exception. `own_panels.jpg` and `own_capture.jpg` show a scene with scans of Google Scanned Objects (Downs and others,
ICRA 2022), copyright 2020 Google LLC, under [CC BY 4.0](https://creativecommons.org/licenses/by/4.0/): frying pan,
plate, white bowl, patterned bowl, basket and ramekin, with smaller textures and an enlarged basket.
`research/own_capture.py` names the page of each. Everything else in that scene, and the demo room, is computed by this
repository. No image of the captures fox, castle and tabletop is in the documentation.

The site contains MathJax (Apache-2.0), which `make docs` fetches from npm.
"""


def packages() -> dict[str, str]:
    """Return the required packages with their purpose, in alphabetical order."""
    found: dict[str, str] = {}
    for line in requires("normlift-ns") or []:
        name = re.split(r"[\s<>=!~;\[(]", line)[0].lower().replace("_", "-")
        extra = re.search(r"extra == ['\"](\w+)['\"]", line)
        if name != "normlift-ns":
            found.setdefault(name, _USES[extra[1] if extra else ""])
    return dict(sorted(found.items()))


def licence(package: str) -> str:
    """Return the license of an installed package: an SPDX expression, else its classifiers, else the first line of its
    text.

    Raises:
        PackageNotFoundError: If the package is neither installed nor in `_UNSTATED`.
    """
    try:
        stated = metadata(package)
    except PackageNotFoundError:
        if package in _UNSTATED:
            return _UNSTATED[package]
        raise
    classifiers = [x.removeprefix(_CLASSIFIER) for x in stated.get_all("Classifier") or [] if x.startswith(_CLASSIFIER)]
    text = (stated["License"] or "").strip().splitlines()
    found = stated["License-Expression"] or ", ".join(classifiers) or (text[0][:_SHORT] if text else "")
    return found or _UNSTATED.get(package, "see its page")


def page() -> str:
    """Return the whole page."""
    table = "".join(f"| {name} | {licence(name)} | {use} |\n" for name, use in packages().items())
    weights = "".join(
        f"- `{name}`, for `{entry.user}`, {entry.size} from {entry.origin}. License: {entry.license}. Training data: "
        f"{entry.data}.\n"
        for name, entry in WEIGHTS.items()
    )
    return HEAD + table + WEIGHTS_HEAD + weights + WORDS + PICTURES


if __name__ == "__main__":
    PAGE.write_text(page(), "utf8")
    sys.stdout.write(f"Written: {PAGE}\n")
