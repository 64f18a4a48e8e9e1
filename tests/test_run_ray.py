"""Tasks on a Ray cluster of a few nodes on this machine: spread, lost, failed, and from the command line.

One of the tests that start a cluster is not slow.
"""

import os
import shutil
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import pytest
from conftest import wait_for

pytest.importorskip("ray")

import ray
from ray.cluster_utils import Cluster
from ray_tasks import die, divide, fail, hold, where

from sagesplat.cli.base import Machine, computing
from sagesplat.core.config import FitConfig, MasksConfig, SceneConfig, TrainConfig
from sagesplat.core.errors import BackendUnavailable, RunError
from sagesplat.core.events import Event, Progress, Warned
from sagesplat.demo.capture import make_capture
from sagesplat.run import ray_cluster, ray_executor, ray_task
from sagesplat.run.executor import Task, results
from sagesplat.run.job import Job
from sagesplat.run.ray_cluster import connected
from sagesplat.run.ray_executor import RayExecutor
from sagesplat.run.ray_task import Failed, WorkerEnvironment, run_task
from sagesplat.run.run_dir import RunDir
from sagesplat.stages.label import lift_labels, make_masks
from sagesplat.stages.observe import observe_levels
from sagesplat.stages.scene import open_scene
from sagesplat.stages.train import train_levels

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="clusters of one machine are POSIX only")
NODE = {"num_cpus": 1, "object_store_memory": 80 * 2**20, "include_dashboard": False}
CODE = "import sys; from sagesplat.cli import main; sys.argv[0] = 'sagesplat'; main()"


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    """Two nodes of one CPU; their processes import this file."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        patch.setenv("PYTHONPATH", str(Path(__file__).parent), prepend=os.pathsep)
        patch.delenv("RAY_ADDRESS", raising=False)
        patch.setenv("RAY_AUTH_MODE", "disabled")  # as somebody else may have started it
        made = Cluster(initialize_head=True, head_node_args=NODE)
        made.add_node(**NODE)
        try:
            with connected(str(made.address)):
                yield made
        finally:
            made.shutdown()


@pytest.fixture
def executor(cluster: Any, tmp_path: Path) -> Iterator[RayExecutor]:
    with closing(RayExecutor(tmp_path / "shared")) as made:
        yield made
    assert not list((tmp_path / "shared").glob(".cluster*"))


def alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    return True


def test_tasks_are_spread_over_the_nodes_and_tell_what_they_do(executor: RayExecutor) -> None:
    events: list[Event] = []
    found = results(executor, [Task("where", where, (number,)) for number in range(4)], events.append)
    assert [number for number, _ in found] == [0, 1, 2, 3]
    assert len({node for _, node in found}) == 2
    assert executor.parallel == 2
    assert 0 < executor.memory < 10**12
    assert [event for event in events if isinstance(event, Warned)] == [Warned("same of all")]
    bar = [event for event in events if isinstance(event, Progress)]
    assert bar[-1] == Progress("where", 8, 8)
    assert [event.done for event in bar] == sorted(event.done for event in bar)


@pytest.mark.slow
def test_an_error_of_the_user_is_its_line_and_ends_the_others(executor: RayExecutor, tmp_path: Path) -> None:
    tasks = [Task("fail", fail, (number, tmp_path)) for number in range(4)]
    with pytest.raises(RunError, match=f"^{tmp_path}: mend it$") as raised:
        results(executor, tasks, lambda event: None)
    assert raised.value.__cause__ is None
    assert results(executor, [Task("divide", divide, (4,))], lambda event: None) == [
        0.25
    ]  # nobody is at work
    assert not [path for path in tmp_path.iterdir() if path.name.isdigit()]


@pytest.mark.slow
def test_a_task_on_a_gpu_takes_its_share_of_the_cpus(cluster: Any, tmp_path: Path, monkeypatch) -> None:
    nodes = [{"CPU": 16.0, "GPU": 4.0, "memory": 64e9}, {"CPU": 8.0, "memory": 8e9}]
    monkeypatch.setattr(RayExecutor, "_nodes", lambda self: nodes)
    on_gpus, on_cpus = RayExecutor(tmp_path, 16, gpus=1), RayExecutor(tmp_path, 4)
    assert (on_gpus.parallel, on_gpus.memory) == (4, 16 * 10**9)
    assert (on_cpus.parallel, on_cpus.memory) == (6, 4 * 10**9)
    with pytest.raises(RunError, match=r"has 32 CPUs \(most CPUs: 16\); use --threads 16"):
        results(RayExecutor(tmp_path, 32), [Task("divide", divide, (1,))], lambda event: None)


@pytest.mark.slow
def test_a_task_whose_process_dies_is_done_again(executor: RayExecutor, tmp_path: Path, monkeypatch) -> None:
    events: list[Event] = []
    assert results(executor, [Task("die", die, (tmp_path, 1))], events.append) == [1]
    (warned,) = [event.text for event in events if isinstance(event, Warned)]
    assert warned.startswith("die (1 of 1): its process on ")
    assert warned.endswith(" was lost; done again (1 of 3)")
    monkeypatch.setattr(ray_executor, "_TRIES", 1)
    often = r"^die \(1 of 1\): its process on .* was lost 2 times \(.*\); look"
    with pytest.raises(RunError, match=often):
        results(executor, [Task("die", die, (tmp_path, 9))], lambda event: None)


@pytest.mark.slow
def test_a_node_that_is_lost_gives_its_task_to_another(
    executor: RayExecutor, cluster: Any, tmp_path: Path
) -> None:
    third: Any = cluster.add_node(**NODE)
    events: list[Event] = []
    lost = third.node_id

    def take_away() -> None:
        wait_for((tmp_path / f"on-{lost}").exists)
        process = int((tmp_path / f"on-{lost}").read_text())
        cluster.remove_node(third, allow_graceful=False)
        wait_for(lambda: not alive(process))
        (tmp_path / "go").touch()

    thread = threading.Thread(target=take_away)
    thread.start()
    found = results(executor, [Task("hold", hold, (tmp_path,)) for _ in range(3)], events.append)
    thread.join()
    assert len(found) == 3
    assert lost not in found
    assert any("was lost; done again (1 of 3)" in e.text for e in events if isinstance(e, Warned))


@pytest.mark.slow
def test_what_no_node_has_is_refused(executor: RayExecutor, tmp_path: Path) -> None:
    wide = RayExecutor(tmp_path / "shared", threads=64)
    with pytest.raises(
        RunError, match=r"divide: no node of the cluster has 64 CPUs \(.*: 1\); use --threads 1$"
    ):
        results(wide, [Task("divide", divide, (1,))], lambda event: None)
    with pytest.raises(RunError, match=r"has 1 CPU, 1 GPU .*; use --device cpu, or add a node with a GPU"):
        results(executor, [Task("divide", divide, (1,), gpus=1)], lambda event: None)
    with pytest.raises(RunError, match=r"has 1 CPU, 9313.2 GiB .*; add a larger node"):
        results(executor, [Task("divide", divide, (1,), memory=10**13)], lambda event: None)


class NoPost:
    """A post that nobody reads."""

    tell = property(lambda self: self)

    def remote(self, *_: object) -> None:
        return None


def test_a_node_without_the_folder_or_with_another_version_is_one_line(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(ray_task, "_VISIBLE", 0.2)
    monkeypatch.setattr(ray, "get", lambda *_, **__: None)
    marker = tmp_path / "marker"
    marker.touch()
    monkeypatch.chdir(tmp_path)
    task = Task("divide", divide, (2,))
    assert run_task(task, WorkerEnvironment(marker, tmp_path), NoPost(), "run", 0, 1) == 0.5
    for environment, says in (
        (
            WorkerEnvironment(tmp_path / "no" / "marker", tmp_path),
            "does not see this folder; all nodes need it under",
        ),
        (WorkerEnvironment(tmp_path / "of another disk", tmp_path), "does not see this folder"),
        (WorkerEnvironment(marker, tmp_path, "0.0.1"), r"not 0\.0\.1; install the same on all nodes"),
    ):
        failed = run_task(task, environment, NoPost(), "run", 0, 1)
        assert isinstance(failed, Failed)
        with pytest.raises(RunError, match=says):
            raise failed.error


@pytest.mark.parametrize(
    ("executor", "says"),
    [
        ("rey", "--executor rey: not known; use local, ray or ray:HOST:PORT"),
        ("ray:127.0.0.1:1", r"--executor ray:127\.0\.0\.1:1: no answer .*`ray start --head`"),
        ("ray:6379", "no answer"),
        ("ray", r"--executor ray: no answer from 127\.0\.0\.1:1, the head of .*`ray stop` here forgets it"),
    ],
)
def test_an_executor_that_is_not_there_is_one_line(
    executor: str, says: str, tmp_path: Path, monkeypatch
) -> None:
    monkeypatch.setattr(ray, "is_initialized", lambda: False)
    monkeypatch.setattr(ray_cluster, "_started_here", lambda: "127.0.0.1:1")  # its head is gone
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    with pytest.raises(RunError, match=says), computing(Machine(executor=executor), tmp_path):
        pass


@pytest.mark.parametrize(
    ("greeting", "patience", "cause"),
    [
        (b"", 0.3, "it does not answer in time"),  # a head whose machine hangs
        (b"HTTP/1.1 400 Bad Request\r\n", 60, "something else than a head of Ray listens there"),
    ],
)
def test_what_listens_but_is_no_head_is_one_line_soon(
    greeting: bytes, patience: float, cause: str, tmp_path: Path, monkeypatch
) -> None:
    """Ray itself would try for a quarter of an hour, and hear no Ctrl-C."""
    monkeypatch.setattr(ray, "is_initialized", lambda: False)
    monkeypatch.setattr(ray_cluster, "_GREETED", patience)
    with socket.create_server(("", 0)) as server:
        address = f"127.0.0.1:{server.getsockname()[1]}"

        def answer() -> None:
            with server.accept()[0] as connection, suppress(OSError):
                connection.sendall(greeting)
                while connection.recv(100):
                    pass

        answering = threading.Thread(target=answer)
        answering.start()
        with (
            pytest.raises(RunError, match=rf"ray:{address}: no answer \({cause}\); name the cluster's head"),
            computing(Machine(executor=f"ray:{address}"), tmp_path),
        ):
            pass
        answering.join()


def test_without_ray_the_cure_is_said(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr("sagesplat.cli.base.find_spec", lambda name: None)
    with (
        pytest.raises(BackendUnavailable, match=r"pip install 'sagesplat\[ray\]'"),
        computing(Machine(executor="ray"), tmp_path),
    ):
        pass


def command(*words: object, **env: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", CODE, *map(str, words)],
        capture_output=True, text=True, timeout=300, env={**os.environ, **env},
    )  # fmt: skip


SHORT = ("--train.max-steps", 20, "--train.level-every", 10, "--ladder", "snapshots", "--threads", 1)


@pytest.fixture
def trained(tmp_path: Path) -> Path:
    """A tiny run up to its training."""
    make_capture(tmp_path / "capture", views=8, width=64, height=48)
    job = Job(RunDir(tmp_path / "run", "snapshots"), lambda event: None)
    open_scene(job, tmp_path / "capture", SceneConfig())
    make_masks(job, MasksConfig())
    lift_labels(job)
    train_levels(job, TrainConfig(max_steps=20, level_every=10), 0)
    return tmp_path / "run"


OBSERVED = "snapshots/observations.csv"


@pytest.mark.slow
def test_the_command_line_on_a_cluster(cluster: Any, trained: Path, tmp_path: Path) -> None:
    shutil.copytree(trained, tmp_path / "other")
    observe_levels(Job(RunDir(trained, "snapshots"), lambda event: None), FitConfig())
    words = ("observe", tmp_path / "other", "--ladder", "snapshots", "--threads", 1)
    made = command(*words, "--executor", f"ray:{cluster.address}")
    assert made.returncode == 0
    (line,) = made.stderr.splitlines()  # nothing else of Ray's
    assert line.startswith("! ray: this Ray cluster does not check tokens: whoever reaches its port can run")
    assert "✓ observe" in made.stdout
    assert (tmp_path / "other" / OBSERVED).read_bytes() == (trained / OBSERVED).read_bytes()


@pytest.mark.slow
def test_a_cluster_of_this_machine_is_started_and_ended(tmp_path: Path) -> None:
    make_capture(tmp_path / "capture", views=8, width=64, height=48)
    words = ("run", tmp_path / "capture", tmp_path / "run", *SHORT, "--executor", "ray")
    made = command(*words, RAY_ADDRESS="local")  # else it would join the cluster of the tests above
    assert (made.returncode, made.stderr) == (0, "")
    assert (tmp_path / "run" / "snapshots" / "report" / "index.html").exists()


ALONE = """
import sys
import ray
from sagesplat.run.ray_cluster import connected
with connected():
    print(ray.get_runtime_context().gcs_address, flush=True)
    sys.stdin.readline()
"""


@pytest.mark.slow
def test_runs_side_by_side_have_a_cluster_each(tmp_path: Path) -> None:
    """Where none was started with `ray start`: RAY_TMPDIR has the address of one that was."""
    environment = {**os.environ, "RAY_ADDRESS": "", "RAY_TMPDIR": str(tmp_path)}
    words = [sys.executable, "-c", ALONE]
    pipe = subprocess.PIPE
    with subprocess.Popen(words, stdin=pipe, stdout=pipe, text=True, env=environment) as first:
        assert first.stdout is not None
        address = first.stdout.readline()
        second = subprocess.run(
            words, input="", capture_output=True, text=True, timeout=120, env=environment, check=False
        )
    assert (second.returncode, second.stderr, first.returncode) == (0, "", 0)
    assert "" != address != second.stdout != ""


OWN = """
import os, sys
import ray
from sagesplat.run.ray_cluster import connected
with connected("local"):
    print(ray.get_runtime_context().gcs_address, os.environ["RAY_AUTH_TOKEN_PATH"], flush=True)
    assert ray.get(ray.remote(lambda: os.getpid()).remote()) != os.getpid()
    print("ready", flush=True)
    sys.stdin.readline()
assert not [name for name in os.environ if name.startswith("RAY_AUTH")]
"""
STRANGER = """
import os, sys
import ray
ray.init(address=sys.argv[1], log_to_driver=False)
print("got in:", ray.get(ray.remote(lambda: os.getpid()).remote()))
"""


def listening(processes: set[int]) -> set[str]:
    """Addresses that processes listen on, as /proc/net has them."""
    inodes = set()
    for process in processes:
        for handle in Path(f"/proc/{process}/fd").iterdir():
            with suppress(OSError):
                inodes.add(os.readlink(handle))
    rows = [
        line.split()
        for table in ("tcp", "tcp6")
        for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]
    ]
    return {row[1].partition(":")[0] for row in rows if row[3] == "0A" and f"socket:[{row[9]}]" in inodes}


def members(of: str, driver: int) -> dict[int, str]:
    """Command lines of the processes of a cluster, whose environment names its folder."""
    found = {driver: Path(f"/proc/{driver}/cmdline").read_text()}
    for folder in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            if of.encode() in (folder / "environ").read_bytes():
                found[int(folder.name)] = (folder / "cmdline").read_text()
    return found


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="looks at /proc")
def test_nobody_else_gets_into_a_cluster_of_our_own() -> None:
    """All of it listens on the loopback, and who has no token is sent away there too."""
    clean = {name: value for name, value in os.environ.items() if not name.startswith("RAY")}
    clean |= {"RAY_USAGE_STATS_ENABLED": "0"}
    with subprocess.Popen(
        [sys.executable, "-c", OWN], env=clean, text=True,
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    ) as driver:  # fmt: skip
        assert driver.stdin is not None
        assert driver.stdout is not None
        assert driver.stderr is not None
        address, file = driver.stdout.readline().split()
        assert driver.stdout.readline() == "ready\n"
        token = Path(file)
        assert len(token.read_text()) == 64
        assert (token.stat().st_mode & 0o777, token.parent.stat().st_mode & 0o777) == (0o600, 0o700)

        processes = members(str(token.parent), driver.pid)
        assert len(processes) > 3
        assert not [line for line in processes.values() if token.read_text() in line]
        places = listening(set(processes))  # how many listen already differs: some start late
        assert places
        assert places <= {"0100007F", "0000000000000000FFFF00000100007F"}

        other = {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": "0" * 64}
        for stranger in ({"RAY_AUTH_MODE": "disabled"}, other):
            # as loopback as the cluster itself: else the address alone would keep it out
            env = clean | stranger | {"RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0"}
            with subprocess.Popen(
                [sys.executable, "-c", STRANGER, address], env=env, text=True,
                stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
            ) as attempt:  # fmt: skip
                assert attempt.stdout is not None
                heard = []
                for line in attempt.stdout:
                    heard.append(line)
                    if "Unauthenticated" in line or "got in" in line:
                        break
                attempt.kill()
            assert "InvalidAuthToken" in heard[-1], heard
        driver.stdin.write("\n")
        driver.stdin.close()
        assert driver.wait(60) == 0
        assert driver.stderr.read() == ""
    assert not token.parent.exists()


DRIVER = """
import sys
from pathlib import Path
from ray_tasks import hold
from sagesplat.run.executor import LOCAL, Task, results
from sagesplat.run.job import Job
from sagesplat.run.ray_cluster import connected
from sagesplat.run.ray_executor import RayExecutor
with connected(sys.argv[1]):
    folder = Path(sys.argv[2])
    results(RayExecutor(folder / "shared"), [Task("hold", hold, (folder,))], lambda event: None)
"""


@pytest.mark.slow
def test_the_tasks_of_a_killed_driver_end(cluster: Any, tmp_path: Path) -> None:
    with subprocess.Popen([sys.executable, "-c", DRIVER, cluster.address, str(tmp_path)]) as driver:
        wait_for(lambda: list(tmp_path.glob("on-*")))
        driver.kill()
    (file,) = tmp_path.glob("on-*")
    process = int(file.read_text())
    wait_for(lambda: not alive(process))
    wait_for(lambda: ray.available_resources().get("CPU") == 2)
