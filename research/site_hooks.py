"""Hooks of mkdocs.yml: pages from outside of docs/, an index, and examples in docstrings as code.

README, CONTRIBUTING, SECURITY and CHANGELOG stay at their usual places, and are also pages of the site.
"""

from __future__ import annotations

import logging
import re
import subprocess
import sys
import tarfile
import tempfile
from importlib import import_module
from pathlib import Path
from typing import Any

import griffe
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[1]
MATHJAX = "3.2.2"
"""Version of MathJax (Apache-2.0) in the site."""
_LOG = logging.getLogger("mkdocs.hooks.normlift")
OUTSIDE = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "contributing.md",
    "SECURITY.md": "security.md",
    "CHANGELOG.md": "changelog.md",
    "research/studies.md": "studies.md",
}
_SOURCE = "https://github.com/normlift-ns/normlift_ns/blob/main/"
_LINK = re.compile(r"\]\((?!https?:|#)([^)#]+)(#[^)]*)?\)")
_DOCTEST = re.compile(r"^(?P<block>(?:>>> .*)(?:\n(?!\s*\n|```).+)*)", re.MULTILINE)


def on_config(config: Any) -> Any:
    """Add the version to the name in the header."""
    found = re.search(r'__version__ = "([^"]+)"', (ROOT / "normlift_ns" / "__init__.py").read_text("utf8"))
    config.site_name = f"{config.site_name} {found[1] if found else ''}".strip()
    return config


def on_files(files: Files, config: Any) -> Files:
    """Add the pages from outside of docs/, the index and MathJax."""
    for name, page in OUTSIDE.items():
        files.append(File.generated(config, page, content=(ROOT / name).read_text("utf8")))
    files.append(File.generated(config, "index_of_options.md", content=index_of_options()))
    script = mathjax()
    if script is not None:
        files.append(File.generated(config, "assets/tex-svg.js", content=script))
    return files


def index_of_options() -> str:
    """Return a page with a heading for every option and every message, so that the search finds them by name."""
    pages = {name: (ROOT / "docs" / f"{name}.md").read_text("utf8") for name in ("options", "troubleshooting")}
    options, messages, command = dict[str, dict[str, list[str]]](), [], ""
    for line in pages["options"].splitlines():
        command = line[3:].partition(":")[0] if line.startswith("## ") else command
        flag, cells = _cells(line)
        if flag.startswith("`--"):
            options.setdefault(flag, {}).setdefault(cells[-1], []).append(command)
    for line in pages["troubleshooting"].splitlines():
        message, cells = _cells(line)
        if message.startswith("`"):
            messages.append(f"### {message}\n\n{cells[0]}\n")
    told = [
        f"### {flag}\n\n" + "".join(f"{text} ({', '.join(names)})\n\n" for text, names in texts.items())
        for flag, texts in sorted(options.items())
    ]
    head = "---\nhide: [toc]\nsearch:\n  boost: 3\n---\n\n# Options and messages, by name\n\n"
    head += "Defaults and ranges are under [options](options.md).\n"
    return "\n".join([head, "## Options\n", *told, "## Messages\n", *messages])


def _cells(line: str) -> tuple[str, list[str]]:
    """Return the first cell of a table row and its other cells; for other lines, the first cell is empty."""
    cells = [cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]] if line.startswith("|") else [""]
    return cells[0], cells[1:]


def mathjax() -> bytes | None:
    """Return MathJax as one file, which npm fetches once, or None if npm or its registry is not available."""
    kept = ROOT / ".cache" / f"mathjax-{MATHJAX}.js"
    if not kept.is_file():
        sys.path.insert(0, str(ROOT / "web"))
        npm = import_module("backend").find_npm()  # the folder of the page's sources is not a package
        with tempfile.TemporaryDirectory() as folder:
            words = ["pack", f"mathjax@{MATHJAX}", "--silent", "--pack-destination", folder]
            try:
                subprocess.run([*(npm or ["npm"]), *words], check=True, capture_output=True, timeout=300)
            except (OSError, subprocess.SubprocessError) as error:
                _LOG.info("formulas stay in TeX, because MathJax cannot be fetched with npm: %s", error)
                return None
            with tarfile.open(Path(folder) / f"mathjax-{MATHJAX}.tgz") as archive:
                script = archive.extractfile("package/es5/tex-svg.js")
                assert script is not None
                kept.parent.mkdir(exist_ok=True)
                kept.write_bytes(script.read())
    return kept.read_bytes()


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Adapt links to the site, and remove the backslashes before bars in code, which tables on GitHub need."""
    outside = page.file.src_uri in OUTSIDE.values()
    markdown = re.sub(r"`[^`\n]+`", lambda found: found[0].replace(r"\|", "|"), markdown)
    markdown = markdown.replace(" ± ", "\N{NO-BREAK SPACE}±\N{NO-BREAK SPACE}")
    return _LINK.sub(lambda found: f"]({_moved(found[1], outside)}{found[2] or ''})", markdown)


def on_page_content(html: str, **_: Any) -> str:
    """Mark flags, which must not be broken over lines."""
    return re.sub(r"<code>(--[a-z][\w-]*(?: [^<\s]{1,12})?)</code>", r'<code class="flag">\1</code>', html)


def _moved(target: str, outside: bool) -> str:
    """Return the target of a link on the site.

    Args:
        outside: True for links on pages from outside of docs/.
    """
    name = target.removeprefix("../") if target.startswith("../") else target if outside else ""
    if name in OUTSIDE:
        return OUTSIDE[name]
    if outside and name.startswith("docs/"):
        return name.removeprefix("docs/")
    if target.startswith("../") or (outside and (ROOT / name).exists()):
        return _SOURCE + name  # a file that is no page
    return target


class Doctests(griffe.Extension):
    """Extension that turns examples after >>> in docstrings into blocks of code."""

    def on_instance(self, *, obj: griffe.Object, **_: Any) -> None:
        """Rewrite the docstring of one object."""
        if obj.docstring is not None:
            text = re.sub(r"<(\w+)>", r"&lt;\1&gt;", obj.docstring.value)
            text = re.sub(r"(?<!\n)\n(Args|Returns|Raises):$", r"\n\n\1:", text, flags=re.MULTILINE)
            obj.docstring.value = _DOCTEST.sub(r"\n```pycon\n\g<block>\n```", text)
