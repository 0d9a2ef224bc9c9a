"""How a team comes together: processes that we start on this machine, or those of torchrun on any number of them."""

from __future__ import annotations

import ctypes
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import timedelta
from functools import partial
from typing import TYPE_CHECKING, Any

from normlift_ns.errors import InputError
from normlift_ns.team.heart import Heart, Lost

if TYPE_CHECKING:
    from normlift_ns.core.portions import Team

TEAM = ("RANK", "WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT")
"""Variables of the environment that describe a team, as torchrun sets them."""
OURS = "NORMLIFT_TEAM"
"""Set in the environment of processes that `start` has started: that process tells what becomes of them."""
KEPT = "2D features and evidence of the views that were done are kept; start the command again to go on from there."
_LONG = timedelta(days=7)
"""What a process may have to wait for another: the heartbeats tell whether it is alive."""
_JOIN = timedelta(minutes=10)
"""What all processes have to come together."""
_PATIENT = 15.0
"""Seconds of waiting of which nothing is said."""
_DIE_WITH_PARENT = 1
"""PR_SET_PDEATHSIG of Linux."""
_LOOPBACK = {"linux": "lo", "darwin": "lo0"}


class LostError(RuntimeError):
    """Another process of the team is gone, or has failed."""

    def __init__(self, lost: Lost) -> None:
        super().__init__(f"process {lost.rank} ({lost.place}) {'has failed' if lost.failed else 'is gone'}")
        self.lost = lost


def rank_of(environment: Mapping[str, str]) -> tuple[int, int] | None:
    """Number and size of the team that an environment describes, as torchrun and `start` set it; None for no team.

    Raises:
        InputError: variables that are no numbers.

    >>> rank_of({"RANK": "1", "WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": "29500"}), rank_of({})
    ((1, 2), None)
    """
    if any(name not in environment for name in TEAM):
        return None
    names = [name for name in TEAM if name != "MASTER_ADDR"]
    numbers = [environment[name] for name in names]
    if not all(number.isdecimal() for number in numbers) or int(numbers[0]) >= int(numbers[1]):
        raise InputError(
            "the environment describes a team of processes that cannot be: "
            + ", ".join(f"{name}={value!r}" for name, value in zip(names, numbers))
            + ". Start ns-normlift by torchrun or with --num-devices, or unset these variables"
        )
    return (int(numbers[0]), int(numbers[1])) if int(numbers[1]) > 1 else None


def start(words: Sequence[str], count: int, say: Callable[[str], None]) -> int:
    """Runs a program in so many processes on this machine, a team; returns the exit code.

    Where one ends before its time the others are ended.

    Args:
        words: of the command line.
        say: told who was ended by a signal. Whoever fails otherwise tells that itself.
    """
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    there = os.environ | {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port), "WORLD_SIZE": str(count), OURS: "1"}
    there.setdefault("OMP_NUM_THREADS", str(max(1, (os.cpu_count() or 1) // count)))
    there.setdefault("NCCL_NVLS_ENABLE", "0")  # multicast buys nothing here, and is one more thing that can fail
    if sys.platform in _LOOPBACK:  # nothing listens to the network
        there |= {name: _LOOPBACK[sys.platform] for name in ("GLOO_SOCKET_IFNAME", "NCCL_SOCKET_IFNAME")}
    processes = [
        subprocess.Popen(
            words if r == 0 else without_log(words),
            env=there | {"RANK": str(r), "LOCAL_RANK": str(r)},
            stdin=subprocess.DEVNULL,
            preexec_fn=bound(),  # noqa: PLW1509 (whoever starts a team has no threads)
        )
        for r in range(count)
    ]
    try:
        return _watch(processes, say)
    except BaseException:  # Ctrl-C or SIGTERM
        _end(processes)
        raise


def without_log(words: Sequence[str]) -> list[str]:
    """A command line without its log file: of several processes the first one keeps it.

    >>> without_log(["ns-normlift", "--log-file", "a.txt", "--quiet"]), without_log(["ns-normlift", "--log_file=a.txt"])
    (['ns-normlift', '--quiet'], ['ns-normlift'])
    """
    left, skip = [], False
    for word in words:
        flag, equals, _ = word.replace("_", "-").partition("=")
        of_log = not skip and flag == "--log-file"
        if not skip and not of_log:
            left.append(word)
        skip = of_log and not equals
    return left


def _watch(processes: Sequence[subprocess.Popen[bytes]], say: Callable[[str], None]) -> int:
    while True:
        codes = [process.poll() for process in processes]
        failed = [(r, code) for r, code in enumerate(codes) if code]
        if len(failed) > 0:
            rank, code = failed[0]
            if code < 0:
                name = signal.Signals(-code).name if -code in set(signal.Signals) else f"signal {-code}"
                hint = ", perhaps by the system for want of memory" if name == "SIGKILL" else ""
                say(f"Process {rank} of 0..{len(processes) - 1} was ended by {name}{hint}. {KEPT}")
            _end(processes)
            return code if code > 0 else 1
        if all(code == 0 for code in codes):
            return 0
        time.sleep(0.1)


def _end(processes: Sequence[subprocess.Popen[bytes]], grace: float = 8.0) -> None:
    for process in processes:
        process.terminate()
    until = time.monotonic() + grace
    for process in processes:
        try:
            process.wait(max(0.0, until - time.monotonic()))
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def bound() -> Callable[[], None] | None:
    """What a new process does first, so that it ends with this one; only Linux can."""
    if sys.platform != "linux":
        return None
    return partial(_follow, ctypes.CDLL(None).prctl, os.getpid())


def _follow(prctl: Callable[..., int], parent: int) -> None:
    prctl(_DIE_WITH_PARENT, signal.SIGTERM)
    if os.getppid() != parent:  # it has ended already
        os._exit(128 + signal.SIGTERM)


def take_device(local_rank: int, device: str) -> None:
    """Leaves a process the GPU of its number alone, before torch has looked for any.

    Raises:
        InputError: there are fewer.
    """
    import torch  # noqa: PLC0415 (the process that only starts others does without)

    count = torch.cuda.device_count() if device != "cpu" else 0
    if count == 0 and device in ("cpu", "auto"):
        return
    if local_rank >= count:
        raise InputError(f"process {local_rank} of this machine finds {count} GPUs, and needs one of its own")
    listed = os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",")
    os.environ["CUDA_VISIBLE_DEVICES"] = listed[local_rank] if local_rank < len(listed) > 1 else str(local_rank)


@contextmanager
def joined(device: str, say: Callable[[str], None]) -> Iterator[Team]:
    """The team of this process while it lasts; `ALONE` where the environment describes none.

    Args:
        device: cpu, cuda or auto.
        say: told who is gone, where nobody else tells it.
    Raises:
        InputError: the processes do not come together, or find too few GPUs.
        LostError: another process is gone.
    """
    found = rank_of(os.environ)
    if found is not None:  # torch's warnings are for those who write such programs; it reads this when it is loaded
        os.environ.setdefault("TORCH_CPP_LOG_LEVEL", "ERROR")
    from normlift_ns.core.portions import ALONE  # noqa: PLC0415 (torch, as above)

    if found is None:
        yield ALONE
        return
    rank, size = found
    take_device(int(os.environ.get("LOCAL_RANK", "0")), device)
    import torch  # noqa: PLC0415 (as above)
    import torch.distributed as dist  # noqa: PLC0415

    from normlift_ns.team.processes import Processes  # noqa: PLC0415

    on_gpu = device != "cpu" and torch.cuda.is_available()
    store, heart = _come_together(rank, size, "nccl" if on_gpu else "gloo", say)
    team = Processes(rank=rank, size=size, device=torch.device("cuda" if on_gpu else "cpu"), store=store)
    try:
        yield team
        team.add(torch.zeros(1))  # until process 0 has written what there is to write
    except BaseException as error:
        lost = heart.lost
        if lost is None and isinstance(error, RuntimeError) and _of_the_network(error):
            lost = heart.wait_for_a_loss()
        if not heart.stop(well=False):  # another one has told of it
            lost = Lost(rank, True, "this one") if lost is None else lost._replace(failed=True)
        if lost is None:
            raise
        raise LostError(lost) from error
    heart.stop(well=True)
    dist.destroy_process_group()


def told(lost: Lost) -> str:
    """What people are told of a process that is gone."""
    return f"Process {lost.rank} ({lost.place}) is gone, so that the others end. {KEPT}"


def _of_the_network(error: Exception) -> bool:
    words = ("gloo", "nccl", "connection", "peer", "socket", "timed out", "timeout")
    return any(word in str(error).lower() for word in words)


def _come_together(rank: int, size: int, backend: str, say: Callable[[str], None]) -> tuple[Any, Heart]:
    """A store for counting, and the heartbeat of this process, which has begun."""
    import torch.distributed as dist  # noqa: PLC0415 (as above)
    from torch.distributed import PrefixStore, TCPStore  # noqa: PLC0415 # pyright: ignore[reportPrivateImportUsage]

    host, port = os.environ["MASTER_ADDR"], int(os.environ["MASTER_PORT"])
    hosts = rank == 0 and os.environ.get("TORCHELASTIC_USE_AGENT_STORE") != "True"
    tell = (lambda text: None) if OURS in os.environ else say
    try:
        fd = None
        if hosts and OURS in os.environ:  # on this machine only, not on every network
            listening = socket.create_server((host, port))
            fd = listening.detach()
        if not hosts:
            _wait(lambda: _answers(host, port), f"process 0 at {host}:{port}", tell)
        how = {"timeout": _JOIN, "wait_for_workers": False}
        store = TCPStore(host, port, size, hosts, master_listen_fd=fd, **how)
        here = PrefixStore("here", store)
        here.set(str(rank), "")
        _wait(lambda: here.check([str(r) for r in range(size)]), f"all {size} processes at {host}:{port}", tell)
        of_the_team = {"store": PrefixStore("team", store), "rank": rank, "world_size": size}
        dist.init_process_group(backend, timeout=_LONG, **of_the_team)
        heart = Heart(
            PrefixStore("heart", TCPStore(host, port, size, False, **how)), rank, size, lambda lost: say(told(lost))
        )
    except TimeoutError as error:
        raise InputError(
            f"process {rank} of {size} has waited {_JOIN} for {error}; are all of them started?"
        ) from error
    except (RuntimeError, OSError) as error:
        raise InputError(
            f"process {rank} of {size} does not find the others at {host}:{port} ({str(error).splitlines()[0]}); are "
            "all of them started, and do firewalls let them through?"
        ) from error
    heart.start()
    return PrefixStore("counts", store), heart


def _wait(ready: Callable[[], bool], what: str, say: Callable[[str], None]) -> None:
    """Waits in Python, which signals can end; raises TimeoutError in the end."""
    begun, warned = time.monotonic(), False
    while not ready():
        waited = time.monotonic() - begun
        if waited > _JOIN.total_seconds():
            raise TimeoutError(what)
        if waited > _PATIENT and not warned:
            warned = True
            say(f"Waiting for {what}. If this is no part of a team, unset {', '.join(TEAM)}.")
        time.sleep(0.1)


def _answers(host: str, port: int) -> bool:
    """Whether anybody listens there."""
    try:
        socket.create_connection((host, port), timeout=5).close()
    except OSError:
        return False
    return True
