"""ns-normlift-serve: serve lifted runs to programs, agents and browsers."""

from __future__ import annotations

import os
import stat
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from normlift_ns.cli.common import TerminatedError, info, run_command, run_command_process
from normlift_ns.cli.preflight import check_lifted_run, check_writable_folder
from normlift_ns.cli.view import ServeOptions, open_all, until_stopped
from normlift_ns.errors import InputError


@dataclass
class NormLiftServe(ServeOptions):
    """Serve lifted runs to programs, browsers and agents. The server has an HTTP API (its client is
    `normlift_ns.connect`), the page of ns-normlift-view and, with --mcp True, tools for agents. Runs stay open while
    memory permits, so queries do not load them again.
    """

    runs: Annotated[
        tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="RUN…", help_behavior_hint="(required)")
    ]
    """Paths to the config.yml files of lifted runs."""
    mcp: bool = False
    """Also serve tools of the Model Context Protocol, at /mcp. If standard input is a pipe, as when an agent starts
    this command, serve only these tools, on standard input and output. The page and the HTTP API are then not
    available. Needs pip install 'normlift-ns[mcp]'."""
    export_dir: Path | None = None
    """Folder in which the tools of --mcp may write files. None, or with --read-only True: the tools write no files."""

    def main(self) -> None:
        """Serve until the process is interrupted, or until the agent closes standard input."""
        if len(self.runs) == 0:
            raise InputError("No run is given. Give the config.yml of a lifted run: ns-normlift-serve RUN/config.yml")
        self.check()
        for config in self.runs:
            check_lifted_run(config, None)
        check_writable_folder(self.export_dir, "--export-dir")
        if self.export_dir is not None and not self.mcp:
            raise InputError("--export-dir has no effect without --mcp; add --mcp True, or leave --export-dir out.")
        server = self.make_server(*self.runs)
        try:
            if self.mcp and stat.S_ISFIFO(os.fstat(sys.stdin.fileno()).st_mode):
                from normlift_ns.server.mcp_tools import serve_stdio  # noqa: PLC0415 (needs mcp)

                serve_stdio(server, self.export_dir)
                return
            if self.mcp:
                from normlift_ns.server.mcp_tools import http_options  # noqa: PLC0415 (needs mcp)

                port = server.start(**http_options(server, self.export_dir))
            else:
                port = server.start()
            self.announce(server, port, "The server")
            open_all(server)
            until_stopped()
        except (KeyboardInterrupt, TerminatedError):
            info("Stopped.")
        finally:
            server.stop()


def entrypoint() -> None:
    """Run ns-normlift-serve, and return to the caller if it succeeds."""
    run_command(NormLiftServe)


if __name__ == "__main__":
    run_command_process(NormLiftServe)
