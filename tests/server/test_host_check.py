"""Who may speak to a server: names, pages of other sites, DNS rebinding, tunnels, odd headers."""

import socket

import pytest

from normlift_ns.errors import InputError
from normlift_ns.server.host_check import accepted_names, refuse_request

LOCAL, EVERY = accepted_names("127.0.0.1", ["Splats.Example.org", "fd00::7"]), accepted_names("0.0.0.0")
OWN = socket.gethostname().lower()


def test_own_names_are_accepted_at_any_port():
    for names, host, *origins in (
        (LOCAL, "localhost:7008"),
        (LOCAL, "localhost:8000", "http://localhost:8000"),  # a tunnel to another port
        (LOCAL, "127.0.0.1", "http://127.0.0.1:80"),
        (LOCAL, "LocalHost.:7008", "http://localhost:7008"),
        (LOCAL, "[::1]:7008", "http://[0:0:0:0:0:0:0:1]:7008"),
        (LOCAL, "splats.example.org", "https://splats.example.org"),
        (LOCAL, "[fd00::7]:9"),
        (EVERY, f"{OWN}:7008", f"http://{OWN}:7008"),
        (EVERY, "127.0.0.2:7008", "http://127.0.0.2:7008"),  # an address of this machine, by its number
        (accepted_names("::1"), "[::1]:7008"),
        (accepted_names("192.0.2.7"), "192.0.2.7:7008", "http://192.0.2.7:7008"),
    ):
        assert refuse_request([host], origins, names) is None, host


def test_other_names_and_pages_are_refused():
    pages = ["https://evil.example", "http://localhost:3000", "http://127.0.0.1:7008", "null", ""]
    pages += ["http://localhost:7008@evil.example", "chrome-extension://localhost:7008"]
    hosts = ["192.168.0.7:7008", "localhost.evil.example", "evil.example@localhost", "2130706433", "localhost:x"]
    hosts += ["localhost, evil.example", "loc\u0430lhost", "[::1", "[:::1]", "[::ffff:127.0.0.1]", "a" * 10000, ""]
    for names, host, origins in (
        *((LOCAL, ["localhost:7008"], [page]) for page in pages),
        *((LOCAL, [host], []) for host in hosts),
        *((names, ["evil.example:7008"], ["http://evil.example:7008"]) for names in (LOCAL, EVERY)),  # DNS rebinding
        (LOCAL, ["localhost:7008"], ["http://localhost:7008", "https://evil.example"]),
        (LOCAL, ["localhost:80"], ["https://localhost"]),
        (LOCAL, ["localhost:7008", "evil.example"], []),
        (LOCAL, [], []),
        (EVERY, ["192.0.2.1:7008"], []),  # an address of another machine
    ):
        assert len(refuse_request(host, origins, names)) > 20, (host, origins)


def test_an_allowed_host_is_the_name_of_a_machine():
    for name in ("http://a.org", "a.org:80", "", "*", "a b", "a/b"):
        with pytest.raises(InputError, match="--allowed-hosts"):
            accepted_names("127.0.0.1", [name])
