"""The server's connections: how many there may be, how long they may stand still, who goes when it is full.

They are counted from the moment they are accepted, TLS handshakes included. One that stands still is closed
after `PATIENCE`: without a whole request, or without a byte of the answer arriving at the other side. When
there is no room for another, the address that holds most loses the one that has done nothing for longest.
"""

import asyncio
import heapq
import logging
import socket
import sys
from asyncio import sslproto
from collections import defaultdict
from collections.abc import Iterator, MutableMapping
from contextlib import suppress
from ipaddress import IPv6Address, ip_address
from pathlib import Path
from typing import Any

import uvicorn
from starlette.types import ASGIApp
from uvicorn.protocols.http.h11_impl import H11Protocol

MOST = 2500  # connections
PATIENCE = 30.0  # seconds
HANDSHAKE = 10.0  # seconds for TLS to begin
_RATE = 16 * 1024  # bytes a second of a download that counts as busy when somebody must go
_EVERY = 1.0  # seconds between two looks at all connections
_BUFFER = 16 * 1024  # bytes that a connection holds of an answer before the next piece is read
_TLS_BUFFER = 8 * 1024  # bytes that asyncio reads at once from each connection, and keeps for it
_FILES = 64  # file handles for all else
_BATCH = 16  # connections that are accepted before the others' turn


def capacity() -> int:
    """Connections that the limit of open files allows, at two files each; it is raised where it may be."""
    try:
        import resource
    except ImportError:  # Windows has no such limit
        return MOST
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = 2 * MOST + _FILES
    infinite = resource.RLIM_INFINITY
    if soft != infinite and soft < wanted:
        with suppress(OSError, ValueError):
            resource.setrlimit(
                resource.RLIMIT_NOFILE, (wanted if hard == infinite else min(wanted, hard), hard)
            )
        soft = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    return MOST if soft == infinite else max(8, min(MOST, (soft - _FILES) // 2))


class Room:
    """The open connections, by the address at their other end."""

    def __init__(self, most: int):
        self.most = most
        self._at_once = max(1, most // 64)  # looking at all costs time, so room is made for a few
        self._by_peer: dict[str, set[Connection]] = defaultdict(set)

    def __iter__(self) -> "Iterator[Connection]":
        return iter([one for crowd in self._by_peer.values() for one in crowd])

    def __len__(self) -> int:
        return sum(map(len, self._by_peer.values()))

    def enter(self, connection: "Connection") -> None:
        """Take one in; where there is no room, those go who have done nothing for longest."""
        if len(self) >= self.most:
            largest = max(map(len, self._by_peer.values()))
            crowds = [crowd for crowd in self._by_peer.values() if len(crowd) == largest]
            now = asyncio.get_running_loop().time()
            every = (one for crowd in crowds for one in crowd)
            for one in heapq.nsmallest(self._at_once, every, key=lambda one: one.worth(now)):
                one.drop()
        self._by_peer[connection.peer].add(connection)

    def leave(self, connection: "Connection") -> None:
        """Forget one, which may be forgotten already."""
        crowd = self._by_peer.get(connection.peer, set())
        crowd.discard(connection)
        if not crowd:
            self._by_peer.pop(connection.peer, None)


class Connection(H11Protocol):
    """A connection that is watched from the moment it is accepted."""

    def __init__(self, server: "Server", sock: socket.socket, peer: str):
        super().__init__(server.config, server.server_state, {})
        self.peer = peer
        self.opening: asyncio.Task[None] | None = None
        self._room, self._socket, self._arrived = server.room, sock, 0
        self._counted: _Counted | None = None  # once it is open
        self.busy = self._moved = self.loop.time()

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """See `asyncio.Protocol`."""
        transport.set_write_buffer_limits(high=_BUFFER)
        self._counted = _Counted(transport)
        super().connection_made(self._counted)  # type: ignore[arg-type]

    def connection_lost(self, exc: Exception | None) -> None:
        """See `asyncio.Protocol`."""
        self._room.leave(self)
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """See `asyncio.Protocol`; only a whole request counts as progress, not its single bytes."""
        before = self.cycle
        super().data_received(data)
        if self.cycle is not before:
            self.busy = self._moved = self.loop.time()

    def on_response_complete(self) -> None:
        """Called when the last of an answer is written; much of it may be on its way still."""
        self.busy = self._moved = self.loop.time()
        super().on_response_complete()

    def timeout_keep_alive_handler(self) -> None:
        """Nothing: uvicorn would cut what is on its way; `look` closes what stands still."""

    def worth(self, now: float) -> tuple[bool, float]:
        """Least for who goes first: without a request or too slow for a while, then by the last activity."""
        return self.cycle is not None and now - self.busy < 2 * _EVERY, self.busy

    def look(self, now: float) -> None:
        """Close what stands still; called every second."""
        arrived = _acknowledged(self._socket)
        if self._counted is not None:
            arrived += self._counted.gone()
        if arrived > self._arrived:
            self._moved = now
        if arrived - self._arrived >= _RATE * _EVERY:
            self.busy = now
        self._arrived = arrived
        if now - self._moved > PATIENCE:
            self.drop()

    def drop(self) -> None:
        """Close at once."""
        self._room.leave(self)
        if self.transport is not None:
            self.transport.abort()
        elif self.opening is not None:
            self.opening.cancel()


class _Counted:
    """A transport that counts what is written to it."""

    def __init__(self, transport: asyncio.Transport):
        self._transport, self._written = transport, 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._transport, name)

    def write(self, data: bytes) -> None:
        """See `asyncio.Transport`."""
        self._written += len(data)
        self._transport.write(data)

    def gone(self) -> int:
        """Bytes that are with the system by now."""
        return self._written - self._transport.get_write_buffer_size()


def _acknowledged(sock: socket.socket) -> int:
    """Bytes that the other side has got, where the system tells (Linux); its buffer hides them else."""
    try:  # `tcpi_bytes_acked` of struct tcp_info
        info = sock.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 128)
    except (AttributeError, OSError):  # another system, or closed
        return 0
    return int.from_bytes(info[120:128], sys.byteorder)


class Server(uvicorn.Server):
    """uvicorn's server with `Room` for its connections."""

    def __init__(self, config: uvicorn.Config):
        super().__init__(config)
        self.room = Room(capacity())
        self._own: list[asyncio.Task[None]] = []

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """See `uvicorn.Server`; the sockets are accepted from here."""
        loop = asyncio.get_running_loop()
        loop.set_exception_handler(_ignore)
        await super().startup([])
        self._own = [loop.create_task(self._accept(each)) for each in sockets or []]
        self._own.append(loop.create_task(self._watch()))

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """See `uvicorn.Server`."""
        for task in self._own:
            task.cancel()
        await super().shutdown(sockets)

    async def _accept(self, listener: socket.socket) -> None:
        loop = asyncio.get_running_loop()
        listener.setblocking(False)
        while True:
            for _ in range(_BATCH):
                try:
                    sock, address = await loop.sock_accept(listener)
                except OSError:  # gone before it was accepted, or no file handle is left
                    await asyncio.sleep(0.05)
                    continue
                connection = Connection(self, sock, _peer(address[0]))
                self.room.enter(connection)
                connection.opening = loop.create_task(self._open(sock, connection))
            await asyncio.sleep(0)

    async def _open(self, sock: socket.socket, connection: Connection) -> None:
        """Hand a socket over to asyncio, after the handshake of TLS."""
        options: dict[str, Any] = {}
        if self.config.ssl:  # what closes is watched as well, so asyncio need not time it
            options = {"ssl_handshake_timeout": HANDSHAKE, "ssl_shutdown_timeout": 1e6}
        loop = asyncio.get_running_loop()
        try:
            with suppress(OSError):  # of TLS too
                if self.config.ssl:
                    await _first_byte(sock)
                await loop.connect_accepted_socket(lambda: connection, sock, ssl=self.config.ssl, **options)
        finally:
            if connection.transport is None:
                self.room.leave(connection)

    async def _watch(self) -> None:
        while True:
            await asyncio.sleep(_EVERY)
            now = asyncio.get_running_loop().time()
            for connection in self.room:
                connection.look(now)


async def _first_byte(sock: socket.socket) -> None:
    """Wait until a handshake begins: who says nothing does not get the 50 kB that TLS needs.

    TimeoutError after `HANDSHAKE`; then the socket is closed.
    """
    loop = asyncio.get_running_loop()
    begun = asyncio.Event()
    try:
        loop.add_reader(sock, begun.set)
    except NotImplementedError:  # Windows
        return
    try:
        await asyncio.wait_for(begun.wait(), HANDSHAKE)
        loop.remove_reader(sock)
    except BaseException:
        loop.remove_reader(sock)
        sock.close()
        raise


def _peer(address: str) -> str:
    """Who is counted as one: an IPv4 address, or the 64 bits of an IPv6 address that a customer gets."""
    ip = ip_address(address.partition("%")[0])
    if isinstance(ip, IPv6Address):
        return str(ip.ipv4_mapped or ip.packed[:8].hex())
    return str(ip)


def _ignore(_loop: asyncio.AbstractEventLoop, _context: dict[str, Any]) -> None:
    """Strangers can make connections fail at will, so the terminal does not hear of it."""


def make_server(site: ASGIApp, certificate: Path | None = None, key: Path | None = None) -> Server:
    """A silent server for `site`, to be `run` on sockets; https with a certificate."""
    logging.getLogger("asyncio").setLevel(logging.CRITICAL)
    sslproto.SSLProtocol.max_size = _TLS_BUFFER  # of 256 kB each, a thousand would be too much
    settings: MutableMapping[str, Any] = {"ssl_certfile": certificate, "ssl_keyfile": key}
    config = uvicorn.Config(
        site, loop="asyncio", ws="none", lifespan="off", log_config=None, log_level="critical",
        access_log=False, server_header=False, proxy_headers=False, timeout_graceful_shutdown=1, **settings,
    )  # fmt: skip
    return Server(config)
