"""Memory that this process may still allocate, as limited by the machine, its cgroups and `ulimit -v`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path

_LIFT_BYTES, _GAUSSIAN_BYTES, _PIXEL_BYTES = 2**29, 600, 32
"""Lower bounds for the memory of a lift, in bytes: fixed, per Gaussian, and per pixel of a view.

The bytes per Gaussian are for its parameters, their copy in the new run, and its scalars.
"""


def free_memory(root: Path = Path("/")) -> dict[str, int]:
    """Return the free bytes under each memory limit, by the name of the limit.

    Limits that the system does not report are left out.

    Args:
        root: Folder that contains proc and sys.
    """
    free: dict[str, int] = {}
    with suppress(OSError, ValueError, IndexError):
        lines = (root / "proc/meminfo").read_text().splitlines()
        free["the machine"] = next(int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:"))
    for limit, used in _cgroup_files(root):
        with suppress(OSError, ValueError):  # such as "max"
            left = int((limit).read_text()) - int(used.read_text())
            free["the cgroup"] = min(left, free.get("the cgroup", left))
    with suppress(ImportError, OSError, ValueError):
        import resource  # noqa: PLC0415 (Unix only)

        limit, _ = resource.getrlimit(resource.RLIMIT_AS)
        if limit != resource.RLIM_INFINITY:
            pages = int((root / "proc/self/statm").read_text().split()[0])
            free["ulimit -v"] = limit - pages * resource.getpagesize()
    return free


def _cgroup_files(root: Path) -> Iterator[tuple[Path, Path]]:
    """Yield the limit file and the usage file of the cgroup of this process and of each parent group.

    Both cgroup versions, 1 and 2, are supported.
    """
    lines: list[str] = []
    with suppress(OSError, ValueError):
        lines = (root / "proc/self/cgroup").read_text().splitlines()
    for line in lines:
        controllers, colon, group = line.partition(":")[2].partition(":")
        if controllers == "" and colon:
            base, names = root / "sys/fs/cgroup", ("memory.max", "memory.current")
        elif "memory" in controllers.split(","):
            base, names = root / "sys/fs/cgroup/memory", ("memory.limit_in_bytes", "memory.usage_in_bytes")
        else:
            continue
        own = base / group.lstrip("/")
        for folder in (own, *own.parents):
            if folder.is_relative_to(base):  # in a container, only the outermost group may be visible
                yield folder / names[0], folder / names[1]


def check_free_memory(needed: int, what: str, needed_by_limit: Mapping[str, int] | None = None) -> None:
    """Raise if a memory limit leaves fewer bytes than an operation needs.

    Args:
        needed: Number of bytes that the operation needs.
        what: Subject of the error message, such as "The lift".
        needed_by_limit: Numbers of bytes that replace `needed` for some limits, by limit name as in `free_memory`.
    Raises:
        MemoryError: A limit leaves fewer bytes. The message gives both numbers.
    """
    for name, free in free_memory().items():
        least = (needed_by_limit or {}).get(name, needed)
        if free < least:
            advice = "Close other programs" if name == "the machine" else "Raise this limit"
            raise MemoryError(
                f"{what} needs at least {_size(least)} of memory, but {name} leaves {_size(max(0, free))}. {advice}, "
                "or use a smaller scene."
            )


def _size(count: int) -> str:
    return f"{count / 2**30:.2f} GiB" if count >= 2**30 else f"{count / 2**20:.0f} MiB"


def refuse_small_memory(gaussians: int = 0, pixels: int = 0, *, loaded: bool = True) -> None:
    """Raise if a lift certainly does not fit into memory.

    Args:
        gaussians: Number of Gaussians.
        pixels: Number of pixels of a view.
        loaded: False if torch is not imported yet. The estimate then includes its libraries for `ulimit -v`, and half a
            GiB for other limits.
    Raises:
        MemoryError: The lift does not fit. The message gives the estimate.
    """
    needed = gaussians * _GAUSSIAN_BYTES + pixels * _PIXEL_BYTES
    if loaded:
        check_free_memory(needed, "The scene")  # also called when other commands open a scene
    else:
        check_free_memory(needed + _LIFT_BYTES, "The lift", {"ulimit -v": needed + _library_bytes()})


def _library_bytes() -> int:
    """Return the total size in bytes of the libraries of torch and CUDA, which a process maps into memory."""
    spec = find_spec("torch")
    places = [] if spec is None else [Path(place) for place in spec.submodule_search_locations or ()]
    files = [file for place in places for file in (*place.glob("lib/*.so*"), *place.parent.glob("nvidia/*/lib/*.so*"))]
    return sum(file.stat().st_size for file in files if file.is_file())
