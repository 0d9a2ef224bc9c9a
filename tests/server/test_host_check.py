"""Who may speak to a server: names, pages of other sites, DNS rebinding, tunnels, odd headers."""

import socket

import pytest

from normlift_ns.errors import InputError
from normlift_ns.server.host_check import accepted_names, refuse_request

LOCAL, EVERY = accepted_names("127.0.0.1", ["Splats.Example.org", "fd00::7"]), accepted_names("0.0.0.0")
OWN = socket.gethostname().lower()


@pytest.mark.parametrize(
    ("names", "host", "origins"),
    [
        (LOCAL, "localhost:7008", []),
        (LOCAL, "localhost:8000", ["http://localhost:8000"]),  # a tunnel to another port
        (LOCAL, "127.0.0.1", ["http://127.0.0.1:80"]),
        (LOCAL, "LocalHost.:7008", ["http://localhost:7008"]),
        (LOCAL, "[::1]:7008", ["http://[0:0:0:0:0:0:0:1]:7008"]),
        (LOCAL, "splats.example.org", ["https://splats.example.org"]),
        (LOCAL, "[fd00::7]:9", []),
        (EVERY, f"{OWN}:7008", [f"http://{OWN}:7008"]),
        (EVERY, "127.0.0.2:7008", ["http://127.0.0.2:7008"]),  # an address of this machine, by its number
        (accepted_names("::1"), "[::1]:7008", []),
        (accepted_names("192.0.2.7"), "192.0.2.7:7008", ["http://192.0.2.7:7008"]),
    ],
)
def test_own_names_are_accepted_at_any_port(names, host, origins):
    assert refuse_request([host], origins, names) is None


@pytest.mark.parametrize(
    ("names", "hosts", "origins"),
    [
        (LOCAL, ["localhost:7008"], ["https://evil.example"]),  # a foreign page
        (LOCAL, ["localhost:7008"], ["http://localhost:3000"]),  # another server of this machine
        (LOCAL, ["localhost:7008"], ["http://127.0.0.1:7008"]),
        (LOCAL, ["localhost:7008"], ["null"]),  # a sandboxed page, or a file
        (LOCAL, ["localhost:7008"], [""]),
        (LOCAL, ["localhost:80"], ["https://localhost"]),
        (LOCAL, ["localhost:7008"], ["http://localhost:7008", "https://evil.example"]),
        (LOCAL, ["localhost:7008"], ["http://localhost:7008@evil.example"]),
        (LOCAL, ["localhost:7008"], ["chrome-extension://localhost:7008"]),
        (LOCAL, ["evil.example:7008"], ["http://evil.example:7008"]),  # DNS rebinding
        (EVERY, ["evil.example:7008"], ["http://evil.example:7008"]),
        (EVERY, ["192.0.2.1:7008"], []),  # an address of another machine
        (LOCAL, ["192.168.0.7:7008"], []),
        (LOCAL, ["localhost.evil.example"], []),
        (LOCAL, ["evil.example@localhost"], []),
        (LOCAL, ["2130706433"], []),
        (LOCAL, ["localhost:7008", "evil.example"], []),
        (LOCAL, ["localhost:x"], []),
        (LOCAL, ["localhost, evil.example"], []),
        (LOCAL, ["loc\u0430lhost"], []),
        (LOCAL, ["[::1"], []),
        (LOCAL, ["[:::1]"], []),
        (LOCAL, ["[::ffff:127.0.0.1]"], []),
        (LOCAL, ["a" * 10000 + "!"], []),
        (LOCAL, [""], []),
        (LOCAL, [], []),
    ],
)
def test_other_names_and_pages_are_refused(names, hosts, origins):
    assert len(refuse_request(hosts, origins, names)) > 20


@pytest.mark.parametrize("name", ["http://a.org", "a.org:80", "", "*", "a b", "a/b"])
def test_an_allowed_host_is_the_name_of_a_machine(name):
    with pytest.raises(InputError, match="--allowed-hosts"):
        accepted_names("127.0.0.1", [name])
