"""Device selection, availability of Triton, batches that fit into GPU memory, and a prefetching `map`."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from functools import cache, cached_property
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from itertools import islice
from threading import Lock, RLock, Thread
from typing import Any, TypeVar, cast

import torch
from torch import Tensor

from normlift_ns.errors import InputError
from normlift_ns.options import check_device, option_name, option_setting

MIN_TRITON_VERSION = 3
Items = TypeVar("Items", Sequence, Tensor)
Item = TypeVar("Item")
Result = TypeVar("Result")
Record = TypeVar("Record")


class shared_property(cached_property[Result]):
    """A thread-safe `cached_property`. One thread computes the value, and the others wait for it."""

    def __init__(self, function: Callable[[Any], Result]) -> None:
        super().__init__(function)
        self._lock = RLock()

    def __get__(self, instance: Any, owner: Any = None) -> Any:
        with self._lock:
            return super().__get__(instance, owner)


class TensorRecord:
    """Base class for dataclasses whose fields are tensors, other such dataclasses, or values without a device."""

    def to(self: Record, device: torch.device | str) -> Record:
        """Return a copy with all tensors on the given device."""
        record = cast(Any, self)  # the subclasses are dataclasses
        values = {field.name: getattr(record, field.name) for field in fields(record)}
        return replace(record, **{name: x.to(device) for name, x in values.items() if hasattr(x, "to")})


@cache
def has_triton() -> bool:
    """Return True if Triton is installed and its version is at least 3 or unknown.

    On Linux, torch 2.4 and later install Triton 3. Without Triton, the default backend on a GPU is gsplat or torch.
    """
    if find_spec("triton") is None:
        return False
    try:
        return int(version("triton").partition(".")[0]) >= MIN_TRITON_VERSION
    except (PackageNotFoundError, ValueError):  # Triton of another distribution, with another version scheme
        return True


def can_use_triton(tensor: Tensor) -> bool:
    """Return True if the tensor is on a GPU and `has_triton` is True."""
    return tensor.is_cuda and has_triton()


def retry_in_halves(run: Callable[[Items], Result], items: Items, advice: str) -> list[Result]:
    """Run a function on all items. If the GPU runs out of memory, split the items into halves recursively.

    Args:
        run: Function that returns the result for some of the items.
        items: Sequence, or tensor that is split along its first dimension.
        advice: Suggestion for the user in the message of the MemoryError.
    Returns:
        The results of all parts, in order.
    Raises:
        MemoryError: If a single item does not fit into GPU memory.
    """
    try:
        return [run(items)]
    except torch.cuda.OutOfMemoryError as error:
        if len(items) <= 1:
            raise MemoryError(f"the GPU's memory is full ({error}); {advice}") from error
    torch.cuda.empty_cache()
    half = len(items) // 2
    return retry_in_halves(run, items[:half], advice) + retry_in_halves(run, items[half:], advice)


def init_cuda(device: str) -> None:
    """Initialize CUDA and Triton in background threads if the device is a GPU. Both take about a second.

    Errors are ignored here, because they occur again when the GPU is first used.
    """

    def start() -> None:
        with suppress(Exception):
            torch.empty(1, device=device)

    for work in (start, load_triton) if device.startswith("cuda") else ():
        Thread(target=work, name="init-cuda", daemon=True).start()


_triton_lock = Lock()


def load_triton() -> None:
    """Compute the hash of Triton's files and load its driver, once per process. All Triton kernels need both.

    Without the lock, every thread that compiles a kernel would compute the hash and compile the driver. Errors are
    ignored here, because they occur again when the first kernel is compiled.
    """
    with _triton_lock, suppress(Exception):
        if has_triton():
            import_module("triton.runtime.cache").triton_key()
            import_module("triton.runtime").driver.active.get_current_target()


def choose_device(device: str) -> str:
    """Return the device to use. "auto" selects cuda if available, else cpu.

    Raises:
        ValueError: If the device is unknown or this machine does not have it.
    """
    device = check_device(device)
    if device.startswith("cuda"):
        count = torch.cuda.device_count()
        if count == 0:
            given, cpu = option_setting("device", device), option_setting("device", "cpu")
            raise InputError(f"{given} needs a CUDA device, but PyTorch finds none; use {cpu}")
        if int(device[5:] or 0) >= count:
            existing = "cuda:0" if count == 1 else f"one of cuda:0 to cuda:{count - 1}"
            raise InputError(f"{option_setting('device', device)} does not exist; use {existing}")
    if device != "auto":
        return device
    return "cuda" if torch.cuda.is_available() else "cpu"


# Prefetching `map`, and batches that adapt to the available GPU memory.


def prefetch_map(function: Callable[[Item], Result], items: Iterable[Item], threads: int) -> Iterator[Result]:
    """Yield the results of `map(function, items)` while computing up to `threads` further results in the background.

    The caller's thread iterates over `items`. Exceptions are raised in the order of the items. With one thread, nothing
    is prefetched.

    >>> list(prefetch_map(abs, [-1, 2, -3], 2))
    [1, 2, 3]
    """
    if threads == 1:
        yield from map(function, items)
        return
    iterator, pending = iter(items), deque[Future[Result]]()

    def submit(count: int) -> None:
        try:
            pending.extend(pool.submit(function, item) for item in islice(iterator, count))
        except Exception as error:  # raised by the iterator of items
            pending.append(Future())
            pending[-1].set_exception(error)

    with ThreadPoolExecutor(threads) as pool:
        try:
            submit(threads)
            while len(pending) > 0:
                result = pending.popleft().result()
                submit(1)
                yield result
        finally:
            pool.shutdown(cancel_futures=True)


@dataclass
class AdaptiveBatches:
    """Batched computation that reduces the batch size if a batch does not fit into GPU memory."""

    batch_size: int
    """Number of items per batch."""

    def __call__(self, function: Callable[[Items], Result], items: Items) -> Iterator[Result]:
        """Yield the results of the function for consecutive batches of items.

        Raises:
            MemoryError: If a single item does not fit into GPU memory.
        """
        start = 0
        while start < len(items):
            batch = items[start : start + self.batch_size]
            results = retry_in_halves(function, batch, self._advice())
            if len(results) > 1:
                self.batch_size = -(-len(batch) // len(results))
            start += len(batch)
            yield from results

    def _advice(self) -> str:
        return (
            f"close other programs that use the GPU, use the CPU ({option_setting('device', 'cpu')}), or lift with a "
            f"smaller model or smaller images (increase {option_name('lift_downscale')})"
        )

    def map_across(
        self, function: Callable[[Sequence[Item]], Tensor], parts: Iterable[Sequence[Item]]
    ) -> Iterator[list[Tensor]]:
        """Yield the result rows of each part, one row per item. A batch may contain items of several parts.

        The last batch is padded with copies of its last item. All batches therefore have the same shape, unless the
        batch size is reduced. The result row of an item depends on the other items of its batch only through rounding.

        The next part is requested when a batch has room for more items. The rows of a part are yielded together, after
        all of them are computed.

        Raises:
            MemoryError: If a single item does not fit into GPU memory.
        """
        counts, queue, rows = deque[int](), list[Item](), deque[Tensor]()
        for part in parts:
            counts.append(len(part))
            queue.extend(part)
            while len(queue) >= self.batch_size:
                batch, queue = queue[: self.batch_size], queue[self.batch_size :]
                rows.extend(row for result in self(function, batch) for row in result)
            while len(counts) > 0 and counts[0] <= len(rows):
                yield [rows.popleft() for _ in range(counts.popleft())]
        if len(queue) > 0:
            padded = [*queue, *[queue[-1]] * (self.batch_size - len(queue))]
            rows.extend([row for result in self(function, padded) for row in result][: len(queue)])
        for count in counts:
            yield [rows.popleft() for _ in range(count)]
