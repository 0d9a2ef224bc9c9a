"""The documentation builds without a warning: links, anchors, names of the reference."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


@pytest.mark.slow
def test_the_site_builds_with_examples_as_code_and_loads_nothing_from_elsewhere(tmp_path):
    words = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(tmp_path)]
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    built = subprocess.run(words, check=False, capture_output=True, text=True, cwd=ROOT, env=environment)
    assert built.returncode == 0, built.stdout + built.stderr
    for page in tmp_path.glob("*.html"):
        loaded = re.findall(r'<(?:script|img|link)[^>]+(?:src|href)="(https?:[^"]+)"', page.read_text("utf8"))
        assert [url for url in loaded if "github.com/normlift-ns" not in url] == [], page.name
    text = (tmp_path / "api.html").read_text("utf8")
    assert "&gt;&gt;&gt; " not in re.sub(r"<pre.*?</pre>", "", text, flags=re.DOTALL)
    assert text.count("&gt;&gt;&gt;") > 50 and "nearest_neighbors" in text
