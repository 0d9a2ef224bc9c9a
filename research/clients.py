"""Many simultaneous clients of ns-normlift-view: errors, latencies and memory.

    python -m research.clients               lifts the fox capture first
    python -m research.clients --load-config outputs/room/normlift/demo/config.yml
    taskset -c 0,1 python -m research.clients --clients-on 2 3

64 clients send one query every 2 s over HTTP for 60 s. Half of the prompts have been sent before, half are new. Each
response contains the relevancies and the mask of all Gaussians. The clients run in one process on the cores of the
server, or on those of `--clients-on`. Shares refer to the processor time of the server's cores. Prompts are names of
colors, for the encoder color.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import random
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import cycle
from pathlib import Path
from urllib.request import urlopen

import numpy as np

import normlift_ns
from research.report import RESULTS, Report
from research.view import COLOURS, ViewServer, fox_run, served

XKCD = Path(normlift_ns.__file__).parent / "encoders" / "xkcd.json"
CLIENTS, PERIOD, SECONDS, SETTLED = 64, 2.0, 60.0, 10.0


@dataclass
class Log:
    """Measurements of the clients."""

    seconds: list[float] = field(default_factory=list)
    errors: list[str] = field(default_factory=list)
    received: int = 0


async def ask(reader: asyncio.StreamReader, writer: asyncio.StreamWriter, path: str, prompt: str) -> tuple[int, int]:
    """Send one query over an open connection, and return the status and the number of bytes of the response."""
    body = json.dumps({"texts": [prompt], "arrays": "safetensors"}).encode()
    writer.write(f"POST {path} HTTP/1.1\r\nHost: localhost\r\nContent-Length: {len(body)}\r\n\r\n".encode() + body)
    head = (await reader.readuntil(b"\r\n\r\n")).decode().lower()
    length = int(head.partition("content-length:")[2].split()[0])
    await reader.readexactly(length)
    return int(head.split()[1]), length


async def client(port: int, path: str, prompts: Iterator[str], log: Log, delay: float) -> None:
    """Send one query every `PERIOD` seconds, the first after a delay."""
    start = time.perf_counter() + delay
    reader, writer = await asyncio.open_connection("127.0.0.1", port, limit=2**20)
    for number in range(int(SECONDS / PERIOD)):
        await asyncio.sleep(max(0.0, start + number * PERIOD - time.perf_counter()))
        asked = time.perf_counter()
        try:
            status, length = await ask(reader, writer, path, next(prompts))
        except (OSError, EOFError) as error:
            log.errors.append(repr(error))
            reader, writer = await asyncio.open_connection("127.0.0.1", port, limit=2**20)
            continue
        log.seconds.append(time.perf_counter() - asked)
        log.received += length
        if status != 200:
            log.errors.append(f"status {status}")
    writer.close()


def questions() -> Iterator[str]:
    """Yield a known prompt and a new one in turn. A new prompt names two colors."""
    names, choice = [*json.loads(XKCD.read_text())], random.Random(0)
    for known in cycle(COLOURS):
        yield known
        yield " ".join(choice.sample(names, 2))


async def ask_all(server: ViewServer, run: str, log: Log) -> tuple[int, int]:
    """Run all clients, and return the memory of the server in bytes after `SETTLED` seconds and at the end."""
    prompts, path = questions(), f"/api/runs/{run}/query"
    delays = [PERIOD * number / CLIENTS for number in range(CLIENTS)]
    tasks = [asyncio.create_task(client(server.port, path, prompts, log, delay)) for delay in delays]
    await asyncio.sleep(SETTLED)
    settled = server.resident()
    await asyncio.gather(*tasks)
    return settled, server.resident()


def add_clients(report: Report, config: Path, clients_on: Sequence[int] = ()) -> None:
    """Add the metrics of a lifted run, with the encoder color."""
    log, cores = Log(), len(os.sched_getaffinity(0))
    with served(config) as server:
        if len(clients_on) > 0:
            os.sched_setaffinity(0, clients_on)
        run = server.run()
        for prompt in COLOURS:
            urlopen(f"http://127.0.0.1:{server.port}/api/runs/{run}/query", json.dumps({"texts": [prompt]}).encode())
        start, worked, own = time.perf_counter(), server.worked(), time.process_time()
        settled, end = asyncio.run(ask_all(server, run, log))
        wall = time.perf_counter() - start
        share = (time.process_time() - own) / (wall * cores)
        used = server.worked() - worked
    for error in sorted(set(log.errors)):
        print(f"{log.errors.count(error)} times: {error}")
    report.add("answers", len(log.seconds), f"answers to {CLIENTS} clients in {wall:.1f} s")
    report.add("errors", len(log.errors), "errors")
    for name, percent in (("median", 50), ("p99", 99), ("most", 100)):
        report.add(f"answer_{name}_s", np.percentile(log.seconds, percent), "s")
    report.add("server_s_per_answer", used / len(log.seconds), "s of processor time of the server per answer")
    report.add("received_bytes_per_s", log.received / wall, "bytes of relevancies and masks per s")
    report.add("clients_share", share, "share of all processor time that the clients take")
    report.add("server_share", used / (wall * cores), "share that the server takes")
    report.add("resident_settled_bytes", settled, f"bytes of memory of the server after {SETTLED:.0f} s")
    report.add("resident_growth_bytes", end - settled, "bytes of memory more at the end")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--load-config", type=Path, help="lifted run; by default the fox capture is lifted first")
    parser.add_argument("--clients-on", type=int, nargs="+", default=(), help="cores of the clients")
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder of the JSON file")
    arguments = parser.parse_args()
    found = Report("clients")
    with tempfile.TemporaryDirectory() as folder:
        add_clients(found, arguments.load_config or fox_run(Path(folder)), arguments.clients_on)
    found.write(arguments.output)
