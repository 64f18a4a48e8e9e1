"""Which Host headers the server answers: what keeps DNS rebinding out.

A page of another site can make its own name point to this machine. Its requests then carry that name, so only
names that are ours are answered. An address is never another site's name.
"""

import socket
from contextlib import suppress
from ipaddress import ip_address
from urllib.parse import urlsplit


class Hosts:
    """The names that a server answers to: loopback names, and where others are let in its own.

    `listening`: what `--host` says, None for this machine only. `certificate`: over https a browser has
    checked the name already, so whoever is let in may use any.
    """

    def __init__(self, listening: str | None = None, *, certificate: bool = False):
        self._open = listening is not None and not is_loopback(listening)
        self._any = self._open and certificate
        self._names = _machine_names() | {_plain(listening or "")} if self._open else set[str]()

    def __contains__(self, host: str) -> bool:
        name = _name(host)
        if name is None:
            return False
        if _is_local_name(name) or self._any:
            return True
        return self._open and (name in self._names or _is_address(name))


def is_loopback(host: str) -> bool:
    """Whether nothing but this machine reaches what listens on a host name or address."""
    with suppress(OSError, UnicodeError):
        found = {entry[4][0] for entry in socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)}
        return bool(found) and all(ip_address(str(address)).is_loopback for address in found)
    return False


def _is_local_name(name: str) -> bool:
    if name == "localhost" or name.endswith(".localhost"):
        return True
    return _is_address(name) and ip_address(name).is_loopback


def _is_address(name: str) -> bool:
    try:
        ip_address(name)
    except ValueError:
        return False
    return True


def _name(host: str) -> str | None:
    """The name in a Host header, without its port; None where there is none."""
    try:
        return _plain(urlsplit(f"//{host}").hostname or "") or None
    except ValueError:
        return None


def _plain(name: str) -> str:
    return name.lower().removesuffix(".")


def _machine_names() -> set[str]:
    """This machine's name, also as multicast DNS has it."""
    name = _plain(socket.gethostname())
    return {name, f"{name.partition('.')[0]}.local"} - {""}
