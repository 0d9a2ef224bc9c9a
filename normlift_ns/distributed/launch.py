"""Start of distributed lifts, by launching processes on this machine or by joining processes of torchrun."""

from __future__ import annotations

import ctypes
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from datetime import timedelta
from functools import partial
from typing import TYPE_CHECKING, Any

from normlift_ns.distributed.heartbeat import Heartbeat, PeerFailure
from normlift_ns.errors import InputError

if TYPE_CHECKING:
    from normlift_ns.distributed.communicator import TorchCommunicator

TORCHRUN_VARIABLES = ("RANK", "WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT")
"""Environment variables that torchrun sets for distributed processes."""
LAUNCHED_VARIABLE = "NORMLIFT_TEAM"
"""Environment variable that marks processes started by `launch_processes`, which reports their termination."""
_RESUME_HINT = (
    "Run the command again; unless --reuse-evidence is False, it reuses the 2D features and evidence of finished views."
)
_COLLECTIVE_TIMEOUT = timedelta(days=7)
"""Longest wait for other processes in a collective operation. Heartbeats detect lost processes earlier."""
_JOIN_TIMEOUT = timedelta(minutes=10)
"""Time limit for the connection of all processes."""
_QUIET_WAIT = 15.0
"""Seconds of waiting before a message is printed."""
_PR_SET_PDEATHSIG = 1
"""Option of Linux's prctl that sets the signal that a process receives when its parent exits."""
_LOOPBACK = {"linux": "lo", "darwin": "lo0"}


def rank_and_world_size(environment: Mapping[str, str]) -> tuple[int, int] | None:
    """Return the rank and world size from variables of torchrun or `launch_processes`, or None for a single process.

    Raises:
        InputError: If a value is not a whole number, or the rank is not below the world size.

    >>> address = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": "29500"}
    >>> rank_and_world_size({"RANK": "1", "WORLD_SIZE": "2", **address}), rank_and_world_size({})
    ((1, 2), None)
    """
    if any(name not in environment for name in TORCHRUN_VARIABLES):
        return None
    values = {name: environment[name] for name in TORCHRUN_VARIABLES if name != "MASTER_ADDR"}
    if not all(value.isdecimal() for value in values.values()) or int(values["RANK"]) >= int(values["WORLD_SIZE"]):
        raise InputError(
            "the environment variables of torchrun are invalid: "
            + ", ".join(f"{name}={value!r}" for name, value in values.items())
            + ". Start ns-normlift with torchrun or --num-devices, or unset these variables"
        )
    rank, size = int(values["RANK"]), int(values["WORLD_SIZE"])
    return (rank, size) if size > 1 else None


def launch_processes(commands: Sequence[Sequence[str]], log: Callable[[str], None]) -> int:
    """Run several processes that lift one scene together on this machine.

    If a process fails, all others are terminated. Each process reports its own errors.

    Args:
        commands: Command line of each process.
        log: Callback for a message about a process that a signal has killed.
    Returns:
        0 if all processes succeed, or the exit code of a process that failed (1 if a signal killed it).
    """
    count = len(commands)
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    env = os.environ | {
        "MASTER_ADDR": "127.0.0.1",
        "MASTER_PORT": str(port),
        "WORLD_SIZE": str(count),
        LAUNCHED_VARIABLE: "1",
    }
    env.setdefault("OMP_NUM_THREADS", str(max(1, (os.cpu_count() or 1) // count)))
    env.setdefault("NCCL_NVLS_ENABLE", "0")  # multicast is not faster for these transfers, and can fail
    if sys.platform in _LOOPBACK:  # do not listen on the network
        env |= dict.fromkeys(("GLOO_SOCKET_IFNAME", "NCCL_SOCKET_IFNAME"), _LOOPBACK[sys.platform])
    processes = [
        subprocess.Popen(
            command,
            env=env | {"RANK": str(r), "LOCAL_RANK": str(r)},
            stdin=subprocess.DEVNULL,
            preexec_fn=exit_with_parent(),  # noqa: PLW1509 (the launcher has no threads)
        )
        for r, command in enumerate(commands)
    ]
    try:
        return _watch(processes, log)
    finally:  # including Ctrl-C and SIGTERM
        end_processes(processes, 8.0)


def _watch(processes: Sequence[subprocess.Popen[bytes]], log: Callable[[str], None]) -> int:
    """Wait until all processes succeed or one fails; return the exit code for `launch_processes`."""
    while True:
        codes = [process.poll() for process in processes]
        rank, code = next(((r, code) for r, code in enumerate(codes) if code), (0, 0))
        if code < 0:
            log(f"Process {rank} (counted from 0) was killed by {describe_signal(-code)}. {_RESUME_HINT}")
        if code != 0 or all(code == 0 for code in codes):
            return max(code, int(code != 0))
        time.sleep(0.1)


def describe_signal(number: int) -> str:
    """Return the name of a signal that killed a process, with a possible reason for SIGKILL.

    >>> describe_signal(15)
    'SIGTERM'
    """
    name = signal.Signals(number).name if number in set(signal.Signals) else f"signal {number}"
    return name + (", possibly because the machine ran out of memory" if name == "SIGKILL" else "")


def end_processes(processes: Sequence[subprocess.Popen[bytes]], grace: float) -> None:
    """Terminate processes, and kill those that are still running after `grace` seconds."""
    for process in processes:
        process.terminate()
    deadline = time.monotonic() + grace
    for process in processes:
        try:
            process.wait(max(0.0, deadline - time.monotonic()))
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def exit_with_parent() -> Callable[[], None] | None:
    """Return a `preexec_fn` that ends a new process when this process exits, or None on systems other than Linux."""
    if sys.platform != "linux":
        return None
    return partial(_die_with_parent, ctypes.CDLL(None).prctl, os.getpid())


def _die_with_parent(prctl: Callable[..., int], parent: int) -> None:
    prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    if os.getppid() != parent:  # the parent has already exited
        os._exit(128 + signal.SIGTERM)


def _use_single_gpu(local_rank: int, device: str) -> None:
    """Hide all GPUs except the one with the local rank of the process, before torch initializes CUDA.

    Do nothing if the process uses the CPU.

    Raises:
        InputError: If the machine has no GPU for the local rank.
    """
    import torch  # noqa: PLC0415 (not needed by the launcher)

    count = torch.cuda.device_count() if device != "cpu" else 0
    if count == 0 and device in ("cpu", "auto"):
        return
    if local_rank >= count:
        raise InputError(
            f"process {local_rank} on this machine needs its own GPU, but PyTorch finds {count}; start at most one "
            "process per GPU, or use --device cpu"
        )
    visible = os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",")
    os.environ["CUDA_VISIBLE_DEVICES"] = visible[local_rank] if local_rank < len(visible) > 1 else str(local_rank)


@contextmanager
def distributed_context(device: str, log: Callable[[str], None]) -> Iterator[TorchCommunicator | None]:
    """Provide a context with the communicator of this process, or with None for a single process.

    Args:
        device: "cpu", "cuda" or "auto".
        log: Callback for messages about a long wait for other processes, and about a lost process that no other process
            reports.
    Raises:
        InputError: If the processes cannot connect, or the machine has too few GPUs. Also for the same reasons as
            `rank_and_world_size`.
        SystemExit: If another process failed or is lost. The exit code is 1.
    """
    ranks = rank_and_world_size(os.environ)
    if ranks is None:
        yield None
        return
    os.environ.setdefault("TORCH_CPP_LOG_LEVEL", "ERROR")  # hides warnings for developers; read when torch is imported
    rank, size = ranks
    _use_single_gpu(int(os.environ.get("LOCAL_RANK", "0")), device)
    import torch  # noqa: PLC0415 (as above)
    import torch.distributed as dist  # noqa: PLC0415

    from normlift_ns.distributed.communicator import TorchCommunicator  # noqa: PLC0415

    on_gpu = device != "cpu" and torch.cuda.is_available()
    store, heart = _connect(rank, size, "nccl" if on_gpu else "gloo", log)
    team = TorchCommunicator(rank=rank, world_size=size, device=torch.device("cuda" if on_gpu else "cpu"), store=store)
    try:
        yield team
        team.all_reduce(torch.zeros(1))  # wait until process 0 has written its files
    except BaseException as error:
        lost = heart.failure
        if lost is None and isinstance(error, RuntimeError) and _is_network_error(error):
            lost = heart.wait_for_failure()
        if not heart.stop(well=False):  # another process has reported its error
            lost = PeerFailure(rank, True, "this one") if lost is None else lost._replace(reported=True)
        if lost is None:
            raise
        if not lost.reported:
            log(describe_failure(lost))
        raise SystemExit(1) from error
    heart.stop(well=True)
    dist.destroy_process_group()


def describe_failure(lost: PeerFailure) -> str:
    """Return a message for the user about a lost process."""
    return f"Process {lost.rank} ({lost.host}) was lost, so the other processes exit. {_RESUME_HINT}"


def _is_network_error(error: Exception) -> bool:
    keywords = ("gloo", "nccl", "connection", "peer", "socket", "timed out", "timeout")
    return any(word in str(error).lower() for word in keywords)


def _connect(rank: int, size: int, backend: str, log: Callable[[str], None]) -> tuple[Any, Heartbeat]:
    """Connect to the other processes; return the store of counters, and the running heartbeat of this process."""
    import torch.distributed as dist  # noqa: PLC0415 (as above)
    from torch.distributed import PrefixStore, TCPStore  # noqa: PLC0415

    host, port = os.environ["MASTER_ADDR"], int(os.environ["MASTER_PORT"])
    is_host = rank == 0 and os.environ.get("TORCHELASTIC_USE_AGENT_STORE") != "True"
    report = (lambda text: None) if LAUNCHED_VARIABLE in os.environ else log
    try:
        fd = None
        if is_host and LAUNCHED_VARIABLE in os.environ:  # listen on this machine only, not on the network
            fd = socket.create_server((host, port)).detach()
        if not is_host:
            _wait(lambda: _is_listening(host, port), f"process 0 at {host}:{port}", report)
        options = {"timeout": _JOIN_TIMEOUT, "wait_for_workers": False}
        store = TCPStore(host, port, size, is_host, master_listen_fd=fd, **options)
        ready = PrefixStore("ready", store)
        ready.set(str(rank), "")
        _wait(lambda: ready.check([str(r) for r in range(size)]), f"all {size} processes at {host}:{port}", report)
        group_store = PrefixStore("group", store)
        dist.init_process_group(backend, timeout=_COLLECTIVE_TIMEOUT, store=group_store, rank=rank, world_size=size)
        heart_store = PrefixStore("heartbeat", TCPStore(host, port, size, False, **options))
        heart = Heartbeat(heart_store, rank, size, lambda lost: log(describe_failure(lost)))
    except TimeoutError as error:
        raise InputError(
            f"process {rank} waited {_JOIN_TIMEOUT.seconds // 60} minutes for {error}; check that all processes were "
            "started and that no firewall blocks them"
        ) from error
    except (RuntimeError, OSError) as error:
        raise InputError(
            f"process {rank} cannot connect to the others at {host}:{port} ({str(error).partition(chr(10))[0]}); check "
            "that no other program uses the port, all processes were started, and no firewall blocks them"
        ) from error
    heart.start()
    return PrefixStore("counts", store), heart


def _wait(ready: Callable[[], bool], target: str, log: Callable[[str], None]) -> None:
    """Wait until `ready` returns True; raise TimeoutError at the time limit.

    The loop runs in Python, so that signals can interrupt it.
    """
    start_time, warned = time.monotonic(), False
    while not ready():
        waited = time.monotonic() - start_time
        if waited > _JOIN_TIMEOUT.total_seconds():
            raise TimeoutError(target)
        if waited > _QUIET_WAIT and not warned:
            warned = True
            log(
                f"Waiting for {target}. If this command should not wait for other processes, unset "
                f"{', '.join(TORCHRUN_VARIABLES)}."
            )
        time.sleep(0.1)


def _is_listening(host: str, port: int) -> bool:
    """Return True if a server accepts connections at an address."""
    with suppress(OSError):
        socket.create_connection((host, port), timeout=5).close()
        return True
    return False
