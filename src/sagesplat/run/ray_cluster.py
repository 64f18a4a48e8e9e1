"""The connection to a Ray cluster, or one of this machine alone, which nobody else can reach.

Whoever can talk to a cluster runs code as its user. So one that we start listens on the loopback, wants a
token that only its own processes know, and keeps its sockets and logs in a folder of the user's own.
"""

import logging
import os
import secrets
import shutil
import signal
import socket
import sys
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import ray
from ray.exceptions import RayError

from sagesplat.core import signals
from sagesplat.core.errors import RunError, short
from sagesplat.run.ray_task import ANSWER, checks_tokens

_STORE = 256 * 2**20  # bytes of shared memory of a cluster of our own: results are small
_TOKENS = ("RAY_AUTH_MODE", "RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH")
_LOOPBACK = "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"  # 0: all of a cluster listens on 127.0.0.1 only
_GREETED = 10.0  # seconds that a head may take to greet
_ASKED = 60.0  # seconds that a process of the cluster may take to start and say whether tokens are checked
_SETTINGS = b"\0\0\0\4\0\0\0\0\0"  # HTTP/2's first frame, by client and server alike (RFC 9113, 3.4)
_GREETING = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + _SETTINGS
_OPEN = (
    "this Ray cluster does not check tokens: whoever reaches its port can run programs as you; start it "
    "with RAY_AUTH_MODE=token (docs/guides/cluster.md)"
)
# Ray's own word on tokens, which depends on its version; we say what matters
_ABOUT_TOKENS = "authentication_token_setup"


@contextmanager
def connected(address: str = "") -> Iterator[Mapping[str, float]]:
    """A connection to a cluster; what it has in all comes back: "CPU", "GPU", "memory" (bytes), ...

    `address` is host:port; without one RAY_ADDRESS or the cluster that `ray start` knows here is taken, else
    one of this machine is started, and ended again. RunError where the cluster does not answer. A connection
    that this process has already is used. Ray's warnings are written to stderr, each once.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "1")  # else it prints a line about it
    if ray.is_initialized():
        yield ray.cluster_resources()
        return
    address = address or os.environ.get("RAY_ADDRESS", "")
    with _heard() as warn:
        if _join(address):
            if _tells_that_it_is_open():
                warn(_OPEN)
            yield from _resources()
        else:
            with _own_cluster():
                yield from _resources()


def _resources() -> Iterator[Mapping[str, float]]:
    try:
        yield ray.cluster_resources()
    finally:
        ray.shutdown()


def _join(address: str) -> bool:
    """Connect to a cluster; False where none is named and none was started here."""
    if address == "local":
        return False
    named = address not in ("", "auto")
    if not named and not (address := _started_here()):
        return False
    _check_answers(address, named)
    try:
        with signals.answered_at_once():  # Ray waits for minutes, and starts nothing here
            _init(address=address)
    except ConnectionError as error:
        raise _no_connection(error) from None
    return True


def _started_here() -> str:
    """The cluster that `ray start` made this machine a node of, "" without one.

    Ray's own "auto" takes any that it finds among the processes, such as another run's, which is not for us.
    """
    from ray._private.services import find_bootstrap_address

    return find_bootstrap_address(None) or ""


def _init(**options: Any) -> None:
    """`ray.init` without the output of tasks; RunError or ConnectionError where it fails."""
    try:
        with signals.deferred():  # processes of a cluster that is half begun would stay
            ray.init(log_to_driver=False, logging_level=logging.WARNING, **options)
    except SystemExit:  # of the handler that Ray sets for SIGTERM, which says nothing
        raise signals.Stopped(signal.SIGTERM) from None
    except ConnectionError:
        raise
    except (OSError, RuntimeError, ValueError, AssertionError, TimeoutError, RayError) as error:
        raise _no_connection(error) from None


def _no_connection(error: Exception) -> RunError:
    cause = short(" ".join(str(error).split()) or repr(error))
    return RunError(
        f"--executor ray: no connection to the cluster ({cause}); make this machine a node of it (`ray start "
        "--address=HOST:PORT`), with the same Ray and Python; if it checks tokens, set RAY_AUTH_MODE=token "
        "and RAY_AUTH_TOKEN_PATH to a file with its token"
    )


@contextmanager
def _own_cluster() -> Iterator[None]:
    """A cluster of this machine that only this process and those that it starts can use."""
    folder = Path(tempfile.mkdtemp(prefix="sagesplat-ray-"))  # for this user only; Ray opens its own to all
    token = folder / "token"
    before = {name: os.environ.get(name) for name in (*_TOKENS, _LOOPBACK)}
    try:
        token.touch(0o600)
        token.write_text(secrets.token_hex(32))
        os.environ.pop("RAY_AUTH_TOKEN", None)
        os.environ |= {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN_PATH": str(token), _LOOPBACK: "0"}
        _reload_variables()
        _init(
            address="local", include_dashboard=False, object_store_memory=_STORE,
            _temp_dir=str(folder / "ray"),
        )  # fmt: skip
        yield
    finally:
        ray.shutdown()
        shutil.rmtree(folder, ignore_errors=True)
        for name, value in before.items():
            os.environ.pop(name, None)
            if value is not None:
                os.environ[name] = value
        _reload_variables()


def _reload_variables() -> None:
    """Let Ray read its variables on tokens and the loopback again.

    It has read them when it was imported, before anybody knew whether a cluster runs here, and nothing public
    lets it do so again: this is why the version of Ray has an upper bound in pyproject.toml.
    """
    from ray._private import ray_constants
    from ray._raylet import AuthenticationTokenLoader, Config  # type: ignore

    given, elsewhere = os.environ.get(_LOOPBACK), not ray_constants.IS_WINDOWS_OR_OSX
    ray_constants.ENABLE_RAY_CLUSTER = elsewhere if given is None else given.lower() in ("true", "1")
    Config.initialize("")
    AuthenticationTokenLoader.instance().reset_cache()


def _tells_that_it_is_open() -> bool:
    """Whether a process of the cluster says that no token is asked for; False where none answers."""
    asked = ray.remote(num_cpus=0)(checks_tokens).remote()
    try:
        return not ray.get(asked, timeout=_ASKED)
    except (RayError, ModuleNotFoundError):  # busy, or without this package: the first task will say so
        ray.cancel(asked)
        return False


class _Warnings(logging.Handler):
    """Writes each warning once, as one line on stderr."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self._said = set[str]()

    def __call__(self, text: str) -> None:
        line = short(" ".join(text.split()))
        if line and line not in self._said:
            self._said.add(line)
            print(f"! ray: {line}", file=sys.stderr)

    def emit(self, record: logging.LogRecord) -> None:
        """See `logging.Handler`."""
        if record.module != _ABOUT_TOKENS:
            self(record.getMessage())


@contextmanager
def _heard() -> Iterator[_Warnings]:
    """Write Ray's warnings as single lines instead of several each."""
    warn, logger = _Warnings(), logging.getLogger("ray")
    handlers = logger.handlers[:]
    logger.handlers[:] = [warn]
    try:
        yield warn
    finally:
        logger.handlers[:] = handlers


def _check_answers(head: str, named: bool) -> None:
    """RunError where no head answers at host:port `head`: Ray itself would wait for a quarter of an hour."""
    host, _, port = head.rpartition(":")
    try:
        with socket.create_connection((host.strip("[]"), int(port)), timeout=ANSWER) as connection:
            if os.environ.get("RAY_USE_TLS", "0") not in ("", "0"):
                return
            connection.settimeout(_GREETED)
            connection.sendall(_GREETING)
            if connection.recv(len(_SETTINGS))[3:4] == _SETTINGS[3:4]:
                return
        cause = "something else than a head of Ray listens there"
    except TimeoutError:
        cause = "it does not answer in time"
    except (ValueError, OverflowError):
        cause = "not HOST:PORT"
    except OSError as error:
        cause = short(error)
    if named:
        raise RunError(
            f"--executor ray:{head}: no answer ({cause}); name the cluster's head as HOST:PORT, "
            "such as ray:10.0.0.1:6379, or start one with `ray start --head`"
        )
    raise RunError(
        f"--executor ray: no answer from {head}, the head of the cluster that this machine belongs to "
        f"({cause}); `ray stop` here forgets it, or start the head again"
    )
