"""The documentation builds without a warning: links, anchors, names of the reference; and it is spelt one way."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "SECURITY.md", *sorted((ROOT / "docs").glob("*.md"))]
_STEMS = (
    "neighbor|color|behavior|favor|honor|labor|gray|labeled|labeling|modeling|center|meters?\\b|analyz|catalog\\b|organiz|"
    "optimiz|recogniz|summariz|normaliz"
)
AMERICAN = re.compile(rf"\b\w*(?:{_STEMS})\w*", re.IGNORECASE)
ALLOWED = {"parameter", "parameters", "hyperparameters", "diameter", "orthonormal", "normalized"}
"""The last one is a quotation: gsplat's --normalize-world-space."""


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    words = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(folder)]
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    built = subprocess.run(words, check=False, capture_output=True, text=True, cwd=ROOT, env=environment)
    assert built.returncode == 0, built.stdout + built.stderr
    return folder


def test_the_site_builds_and_loads_nothing_from_elsewhere(site):
    for page in site.glob("*.html"):
        text = page.read_text("utf8")
        loaded = re.findall(r'<(?:script|img|link)[^>]+(?:src|href)="(https?:[^"]+)"', text)
        assert [url for url in loaded if "github.com/normlift-ns" not in url] == [], page.name


def test_examples_are_code_and_signatures_are_there(site):
    text = (site / "api.html").read_text("utf8")
    assert "&gt;&gt;&gt; " not in re.sub(r"<pre.*?</pre>", "", text, flags=re.DOTALL)
    assert text.count("&gt;&gt;&gt;") > 50 and "nearest_neighbors" in text


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_the_spelling_is_british(page):
    text = re.sub(
        r"```.*?```|^:::.*?$|^ {4,}.*?$|`[^`]*`|\]\([^)]*\)",
        " ",
        page.read_text("utf8"),
        flags=re.DOTALL | re.MULTILINE,
    )
    assert {word.lower() for word in AMERICAN.findall(text)} - ALLOWED == set()
