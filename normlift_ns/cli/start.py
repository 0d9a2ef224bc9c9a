"""Entry points that import a command only when called, and print no traceback if Ctrl-C interrupts the import."""

from __future__ import annotations

import os
import sys
from functools import partial
from importlib import import_module


def _start(module: str, command: str) -> None:
    try:
        found = getattr(import_module(f"normlift_ns.cli.{module}"), command)
        import_module("normlift_ns.cli.common").run_command_process(found)
    except KeyboardInterrupt:  # during the import; later, the command handles it
        sys.stderr.write("Interrupted.\n")
        sys.stderr.flush()
        os._exit(130)


def _serve(module: str, command: str) -> None:
    # OpenMP threads that wait actively would take CPU time from other requests
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    _start(module, command)


lift = partial(_start, "lift", "NormLift")
query = partial(_start, "query", "NormLiftQuery")
export = partial(_start, "export", "NormLiftExport")
evaluate = partial(_start, "evaluate", "NormLiftEval")
view = partial(_serve, "view", "NormLiftView")
serve = partial(_serve, "serve", "NormLiftServe")
batch = partial(_start, "batch", "NormLiftBatch")
check = partial(_start, "check", "NormLiftCheck")
weights = partial(_start, "weights", "NormLiftWeights")
