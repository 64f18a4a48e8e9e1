"""`sagesplat view` under load: idle, slow and honest clients at once, from another process.

python -m benchmarks.server [--idle 1000] [--slow 1000] [--honest 200]
"""

import asyncio
import hashlib
import random
import resource
import ssl
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import tyro

from benchmarks.common import finish

FILES, SIZE = 10, 200_000  # files of a bundle, and bytes of each
LARGE = 20_000_000  # bytes of a file that is read slowly
_AGAIN = 1.0  # seconds until a bad client that was cut off comes back
_TRICKLE = 0.2  # seconds between two bytes of a slow request, and between two reads of a slow reader
_PATIENCE = 60.0  # seconds that an honest client waits for a file


def make_bundle(folder: Path) -> dict[str, str]:
    """A bundle of random files; SHA-256 by name."""
    rng, hashes = random.Random(0), {}
    (folder / "chunks").mkdir(parents=True)
    (folder / "manifest.json").write_text('{"format": "sagesplat-bundle", "labels": []}')
    (folder / "large.spz").write_bytes(bytes(LARGE))
    for number in range(FILES):
        content = rng.randbytes(SIZE)
        digest = hashlib.sha256(content).hexdigest()
        name = f"chunks/some-{number:02d}-{digest[:12]}.spz"
        (folder / name).write_bytes(content)
        hashes[name] = digest
    return hashes


def make_certificate(folder: Path) -> tuple[Path, Path]:
    """A certificate for localhost and its key; needs openssl."""
    certificate, key = folder / "cert.pem", folder / "key.pem"
    subprocess.run(
        ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "2", "-subj", "/CN=localhost",
         "-addext", "subjectAltName=DNS:localhost", "-keyout", key, "-out", certificate],
        check=True, capture_output=True,
    )  # fmt: skip
    return certificate, key


def measure(idle: int, slow: int, honest: int, tls: bool, files: int = FILES) -> dict[str, Any]:
    """Who finished, seconds, and the server's memory and lines; `files`: what each honest client loads."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = min(idle + slow + honest + 100, hard)
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, wanted), hard))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        hashes = make_bundle(folder / "bundle")
        command = [sys.executable, "-m", "sagesplat", "view", folder / "bundle"]
        command += ["--port", "0", "--no-browser"]
        context = None
        if tls:
            certificate, key = make_certificate(folder)
            command += ["--ssl-certfile", certificate, "--ssl-keyfile", key]
            context = ssl.create_default_context(cafile=str(certificate))
        terminal = folder / "terminal"
        with (
            terminal.open("wb") as output,
            subprocess.Popen(command, stdout=output, stderr=subprocess.STDOUT) as server,
        ):
            try:
                clients = _Clients(_port(terminal), context, dict(list(hashes.items())[:files]))
                found = asyncio.run(clients.run(idle, slow, honest))
                found["server_rss_mb"] = _peak_memory(server.pid)
            finally:
                server.terminate()
        found["terminal_lines"] = len(terminal.read_text().splitlines())
    return {"tls": tls, "idle": idle, "slow": slow, "honest": honest, **found}


def _port(terminal: Path) -> int:
    end = time.monotonic() + _PATIENCE
    while time.monotonic() < end:
        lines = terminal.read_text().splitlines()
        if len(lines) >= 3:
            return int(lines[0].rstrip("/").rpartition(":")[2])
        time.sleep(0.05)
    raise TimeoutError(terminal.read_text())


def _peak_memory(process: int) -> float:
    """The most memory that a process has had, in MB."""
    lines = Path(f"/proc/{process}/status").read_text().splitlines()
    peak = next(line for line in lines if line.startswith("VmHWM"))
    return int(peak.split()[1]) * 1024 / 1e6


class _Clients:
    """All clients of one server, in this process."""

    def __init__(self, port: int, context: ssl.SSLContext | None, hashes: dict[str, str]):
        self._port, self._context, self._hashes = port, context, hashes
        self._open = self._cut = 0
        self._latencies: list[float] = []

    async def run(self, idle: int, slow: int, honest: int) -> dict[str, Any]:
        """Start the bad ones and, while they come, the honest ones."""
        begin = time.perf_counter()
        ways = [self._idle] * idle + [self._trickle, self._read_slowly] * (slow // 2)
        random.Random(1).shuffle(ways)
        bad = [asyncio.create_task(self._for_ever(way)) for way in ways]
        if bad:
            await asyncio.sleep(1.0)  # they are there first
        done = await asyncio.gather(*(self._load(number) for number in range(honest)))
        seconds = time.perf_counter() - begin
        for task in bad:
            task.cancel()
        await asyncio.gather(*bad, return_exceptions=True)
        waits = sorted(self._latencies)
        return {
            "finished": sum(done),
            "seconds": seconds,
            "file_median_s": waits[len(waits) // 2] if waits else None,
            "file_longest_s": waits[-1] if waits else None,
            "bad_connections": self._open,
            "bad_cut": self._cut,
        }

    async def _for_ever(self, way: Any) -> None:
        while True:
            writer = None
            try:
                reader, writer = await self._connect(tls=way is not self._idle)
                self._open += 1
                await way(reader, writer)
            except (OSError, asyncio.IncompleteReadError, ssl.SSLError):
                pass
            finally:
                if writer:
                    writer.transport.abort()
            self._cut += 1
            await asyncio.sleep(_AGAIN)

    async def _connect(self, tls: bool = True) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        name = "localhost" if self._context and tls else None
        options: dict[str, Any] = {"ssl": self._context, "server_hostname": name} if name else {}
        return await asyncio.open_connection("127.0.0.1", self._port, limit=4096, **options)

    async def _idle(self, reader: asyncio.StreamReader, _writer: asyncio.StreamWriter) -> None:
        """Says nothing: with TLS not even a handshake."""
        await reader.read(1)

    async def _trickle(self, _reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        for byte in b"GET /manifest.json HTTP/1.1\r\nHost: localhost\r\nX: " + b"x" * 10_000:
            writer.write(bytes([byte]))
            await writer.drain()
            await asyncio.sleep(_TRICKLE)

    async def _read_slowly(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(b"GET /large.spz HTTP/1.1\r\nHost: localhost\r\n\r\n")
        while await reader.read(200):  # 1 kB/s
            await asyncio.sleep(_TRICKLE)

    async def _load(self, number: int) -> bool:
        """All files with the right hashes, over one connection, as a browser would."""
        names = list(self._hashes)
        names = names[number % len(names) :] + names[: number % len(names)]
        try:
            reader, writer = await asyncio.wait_for(self._connect(), _PATIENCE)
            for name in names:
                begin = time.perf_counter()
                content = await asyncio.wait_for(self._fetch(name, reader, writer), _PATIENCE)
                self._latencies.append(time.perf_counter() - begin)
                if hashlib.sha256(content).hexdigest() != self._hashes[name]:
                    return False
            writer.close()
        except (OSError, EOFError, TimeoutError, ssl.SSLError):
            return False
        return True

    async def _fetch(self, name: str, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> bytes:
        writer.write(f"GET /{name} HTTP/1.1\r\nHost: localhost\r\n\r\n".encode())
        head = await reader.readuntil(b"\r\n\r\n")
        if not head.startswith(b"HTTP/1.1 200"):
            return b""
        length = next(line for line in head.lower().splitlines() if line.startswith(b"content-length:"))
        return await reader.readexactly(int(length.partition(b":")[2]))


def main(idle: int = 1000, slow: int = 1000, honest: int = 200, write: bool = False) -> None:
    """`sagesplat view` with idle, slow and honest clients at once, plain and over TLS."""
    rows = [measure(idle, slow, honest, tls) for tls in (False, True)]
    for row in rows:
        print(
            f"{'TLS' if row['tls'] else 'plain':5} {row['finished']} of {honest} honest ones finished"
            f" in {row['seconds']:.0f} s (a file {row['file_median_s']:.1f} s, at most"
            f" {row['file_longest_s']:.1f});"
            f" server {row['server_rss_mb']:.0f} MB, terminal {row['terminal_lines']} lines"
        )
    finish("server", {"rows": rows}, write)


if __name__ == "__main__":
    tyro.cli(main, prog="python -m benchmarks.server")
