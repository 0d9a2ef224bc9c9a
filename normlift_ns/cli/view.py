"""ns-normlift-view: view a lifted run in the browser, which renders the Gaussians."""

from __future__ import annotations

import socket
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from normlift_ns.cli.common import TerminatedError, info, run_command, run_command_process
from normlift_ns.cli.preflight import check_lifted_run, check_readable_file
from normlift_ns.errors import InputError
from normlift_ns.options import CheckedOptions, check_device, renamed
from normlift_ns.server.host_check import accepted_names

if TYPE_CHECKING:
    from normlift_ns.lifted_run import LiftedRun
    from normlift_ns.server.app import WarmServer


@dataclass(kw_only=True)
class ServeOptions(CheckedOptions):
    """Options of commands that serve lifted runs."""

    host: str = "127.0.0.1"
    """Address to listen on. 127.0.0.1: accept connections from this machine only. 0.0.0.0: also accept connections from
    other machines."""
    allowed_hosts: tuple[str, ...] = ()
    """Further host names under which browsers and programs may reach the server, such as that of a proxy. The server
    rejects requests for other host names with status 403."""
    port: int = 7008
    """Port to listen on, in 1..65535. If it is in use, the server takes the first free one of the next 99 ports."""
    read_only: bool = False
    """Prevent visitors from storing prompts in a run."""
    max_gaussians: int = 1_000_000
    """Maximum number of Gaussians that a browser renders. Larger scenes show only their most opaque and largest
    Gaussians. Larger values need more browser memory."""
    device: str = "auto"
    """Device for the text encoder: auto, cpu, cuda, or one GPU such as cuda:1."""

    def check(self) -> None:
        """Raise InputError if the server cannot listen at the address, or an option is not valid."""
        check_device(self.device)
        _check_host(self.host)
        accepted_names(self.host, self.allowed_hosts)

    def make_server(self, *configs: Path) -> WarmServer:
        """Return a server for the given runs, without starting it."""
        from normlift_ns.server.app import ServerOptions, WarmServer  # noqa: PLC0415 (--help should not wait for torch)
        from normlift_ns.server.runs import RunStore  # noqa: PLC0415

        options = ServerOptions(self.host, self.port, self.allowed_hosts, self.read_only)
        return WarmServer(RunStore(configs, self.open_run, max_gaussians=self.max_gaussians), options)

    def open_run(self, config: Path) -> LiftedRun:
        """Open a run."""
        from normlift_ns.lifted_run import open_run  # noqa: PLC0415 (as above)

        return open_run(config, device=self.device)

    def announce(self, server: WarmServer, port: int, what: str) -> None:
        """Print the address of a server, in a sentence that begins with `what`, and remarks about port and access."""
        if port != self.port:
            info(f"Port {self.port} is not available.")
        host = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(self.host, self.host)
        host = f"[{host}]" if ":" in host else host
        info(f"{what} is at http://{host}:{port} (press Ctrl-C to stop it)")
        if not server.options.is_local and not self.read_only:
            info(f"To store prompts from other machines too, add ?access={server.options.access_token} to the address.")


@renamed(
    share_readonly="read_only",
    most_drawn="max_gaussians",
    text_vectors="text_embeddings",
    text_template="prompt_template",
)
@dataclass
class NormLiftView(ServeOptions):
    """View a lifted run in the browser, to search, select, hide and export Gaussians. The browser renders the scene, so
    this machine needs no GPU.
    """

    load_config: Path
    """Path to the config.yml file of the lifted run."""
    text_embeddings: Path | None = None
    """NPZ file with one vector per prompt, used instead of the text encoder of the run."""
    prompt_template: str | None = None
    """Template of the text that the network encodes, with {} for the prompt. None: the template of the lift."""
    data: Path | None = None
    """Current path of the dataset, if it was moved."""

    def main(self) -> None:
        """Serve the viewer until the process is interrupted."""
        self.check()
        check_lifted_run(self.load_config, self.data)
        check_readable_file(self.text_embeddings, "--text-embeddings")
        server = self.make_server(self.load_config)
        self.announce(server, server.start(), "The viewer")
        try:
            open_all(server)
            until_stopped()
        except (KeyboardInterrupt, TerminatedError):
            info("Stopped.")
        finally:
            server.stop()

    def open_run(self, config: Path) -> LiftedRun:
        """Open the run."""
        from normlift_ns.lifted_run import open_run  # noqa: PLC0415 (as above)

        texts = {"text_embeddings": self.text_embeddings, "prompt_template": self.prompt_template}
        return open_run(config, data=self.data, device=self.device, **texts)


def open_all(server: WarmServer) -> None:
    """Open the runs of a server, and start a thread that prepares the data of their first pages."""
    for name in server.runs.ids:
        server.runs.get(name)
    threading.Thread(target=server.warm_up, daemon=True).start()


def until_stopped() -> NoReturn:
    """Wait for Ctrl-C or SIGTERM.

    The loop wakes up every second. An endless wait would miss a signal that reaches another thread, or this thread
    just before it waits.
    """
    while True:
        time.sleep(1)


def _check_host(host: str) -> None:
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as probe:
            probe.bind(address)
    except (OSError, UnicodeError) as error:
        raise InputError(
            f"--host {host} is not an address that this machine can listen on ({error}). Leave it out to accept "
            "connections from this machine only, or give 0.0.0.0 to accept connections from other machines as well."
        ) from None


def entrypoint() -> None:
    """Run ns-normlift-view, and return to the caller if it succeeds."""
    run_command(NormLiftView)


if __name__ == "__main__":
    run_command_process(NormLiftView)
