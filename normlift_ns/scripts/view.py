"""ns-normlift-view: a lifted run in the browser, which draws the Gaussians itself."""

from __future__ import annotations

import socket
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from normlift_ns.errors import InputError
from normlift_ns.ranges import check_device, check_options
from normlift_ns.scripts.early import check_lifted, readable_file
from normlift_ns.scripts.shared import Terminated, run_command, run_process, say

if TYPE_CHECKING:
    from normlift_ns.viewer.serving.door import Door


@dataclass
class NormLiftView:
    """Look at a lifted run in the browser: ask, select, hide and export. The browser draws, so that no GPU is needed
    here.

    Colours are those of spherical harmonics of degree 0.
    """

    load_config: Path
    """Path to config YAML file of the lifted run."""
    host: str = "127.0.0.1"
    """Address to listen at. By default only this machine can look; 0.0.0.0 lets everybody in who can reach it."""
    port: int = 7008
    """Port to listen at; the next one that is free, if it is taken."""
    share_readonly: bool = False
    """Let nobody store prompts in the run or write files here; files go to the downloads of the browser."""
    most_drawn: int = 1_000_000
    """Number of Gaussians to draw at most. Of larger scenes the most opaque and largest are shown."""
    text_vectors: Path | None = None
    """NPZ file, text -> vector, to look texts up in instead of encoding them."""
    text_template: str | None = None
    """What open_clip reads for a text, which takes the place of {}. By default as the run was lifted."""
    data: Path | None = None
    """Where the dataset is now, if it was moved."""
    device: str = "auto"
    """Where the text encoder runs: auto, cpu or cuda."""

    def __post_init__(self) -> None:
        check_options(self)

    def main(self) -> None:
        """Serves until it is interrupted."""
        check_device(self.device)
        _check_host(self.host)
        check_lifted(self.load_config, self.data)
        readable_file(self.text_vectors, "--text-vectors")
        from normlift_ns.viewer.serving.door import Door  # noqa: PLC0415 (--help should not wait for viser)

        door = Door(self.host, self.port)
        if door.server.port != self.port:
            say(f"Port {self.port} is taken.")
        host = "127.0.0.1" if self.host == "0.0.0.0" else self.host
        say(f"The viewer is at http://{host}:{door.server.port} (Ctrl-C ends it)")
        try:
            self.open(door)
            until_stopped()
        except (KeyboardInterrupt, Terminated):
            say("Stopped.")

    def open(self, door: Door) -> None:
        """Reads the run, and lets in who waits before the door; returns at once."""
        from normlift_ns.front_door import open_run  # noqa: PLC0415 (pages load while torch is imported)
        from normlift_ns.session.space import Space  # noqa: PLC0415
        from normlift_ns.viewer.people import People  # noqa: PLC0415
        from normlift_ns.viewer.records import make_records  # noqa: PLC0415
        from normlift_ns.viewer.shared import Run  # noqa: PLC0415

        run = open_run(
            self.load_config,
            data=self.data,
            device=self.device,
            text_vectors=self.text_vectors,
            text_template=self.text_template,
        )
        space = Space(run.field, run.scene.gaussians.means.detach())
        records = make_records(run.scene, self.most_drawn)
        shared = Run(run.folder, run.scene, space, records, lambda: run.texts, self.share_readonly, lambda: run.votes)
        people = People(shared)
        door.open(f"normlift: {run.scene.name}", people.come, people.go)


def until_stopped() -> NoReturn:
    """Waits for Ctrl-C or SIGTERM. It looks every second: a signal that reaches another thread of the process, or this
    one just before it waits, would not wake a wait without end.
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
            f"--host {host} is no address that this machine can listen at ({error}). Leave it out to let only this "
            "machine look, or give 0.0.0.0 to let everybody in who can reach it."
        ) from None


def entrypoint() -> None:
    """ns-normlift-view, in a process that goes on."""
    run_command(NormLiftView)


def main() -> None:
    """Entry point of ns-normlift-view."""
    run_process(NormLiftView)


if __name__ == "__main__":
    main()
