"""Downloads, from a server on this machine, of files that look like the published ones."""

import hashlib
import threading
from dataclasses import replace
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer

import pytest
import torch

from sagesplat.core.errors import DataError
from sagesplat.download.weights import SOURCES, Source, download_lpips
from sagesplat.metrics.lpips import Net, load_lpips, shapes


class Handler(SimpleHTTPRequestHandler):
    """Serves a folder; of files named cut..., half of what it announces."""

    def log_message(self, format, *args):
        pass

    def copyfile(self, source, outputfile):
        content = source.read()
        outputfile.write(content[: len(content) // 2] if self.path.startswith("/cut") else content)


def state_dicts(net, source):
    """What torchvision and the authors publish: convolution k is full of k, and so is head k."""
    backbone, heads = {"classifier.1.weight": torch.zeros(2, 2)}, {}
    for name, shape in shapes(net).items():
        k, _, part = name.removeprefix("conv").removeprefix("lin").partition(".")
        value = torch.tensor(float(k))
        if part:
            backbone[f"features.{source.convolutions[int(k)]}.{part}"] = value.expand(shape)
        else:
            heads[f"lin{k}.model.1.weight"] = value.expand(1, *shape, 1, 1)
    return backbone, heads


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    """A folder of small files and the address at which it is served."""
    folder = tmp_path_factory.mktemp("served")
    for net, source in SOURCES.items():
        backbone, heads = state_dicts(net, source)
        torch.save(backbone, folder / f"{net}_backbone.pth")
        torch.save(heads, folder / f"{net}.pth", _use_new_zipfile_serialization=False)  # as in 2018
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Handler, directory=str(folder)))
    thread = threading.Thread(target=server.serve_forever, args=(0.01,))
    thread.start()
    yield folder, f"http://127.0.0.1:{server.server_port}"
    server.shutdown()
    thread.join()
    server.server_close()


@pytest.fixture
def sources(served, monkeypatch) -> dict[Net, Source]:
    monkeypatch.setenv("no_proxy", "*")
    folder, base = served
    return {
        net: Source(
            f"{base}/{net}_backbone.pth",
            sha256_of(folder / f"{net}_backbone.pth"),
            source.convolutions,
            f"{base}/{net}.pth",
            sha256_of(folder / f"{net}.pth"),
        )
        for net, source in SOURCES.items()
    }


def sha256_of(path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def changed(sources, **fields) -> dict[Net, Source]:
    return {"alex": replace(sources["alex"], **fields)}


def test_what_is_published_becomes_what_is_loaded(sources, served, tmp_path, monkeypatch):
    monkeypatch.setenv("SAGESPLAT_CACHE", str(tmp_path))
    calls = []
    paths = download_lpips(on_progress=lambda *call: calls.append(call), sources=sources)
    assert paths == [tmp_path / "lpips" / "lpips_alex.npz", tmp_path / "lpips" / "lpips_vgg.npz"]
    assert sorted((tmp_path / "lpips").iterdir()) == paths
    for net in SOURCES:
        for name, values in load_lpips(net).weights.items():
            k = int("".join(filter(str.isdigit, name)))
            assert (values == k).all(), name
    sizes = {name: (served[0] / name).stat().st_size for name, _, _ in calls}
    assert list(sizes) == ["alex.pth", "alex_backbone.pth", "vgg.pth", "vgg_backbone.pth"]
    assert [call for call in calls if call[1] == call[2]] == [
        (name, size, size) for name, size in sizes.items()
    ]


def test_files_that_are_there_stay(sources, tmp_path):
    (path,) = download_lpips(tmp_path, ["alex"], sources=sources)
    before = path.stat()
    gone = changed(sources, heads="file:///nowhere", backbone="file:///nowhere")
    assert download_lpips(tmp_path, ["alex"], sources=gone) == [path]
    after = path.stat()  # reading it may change its access time
    assert (after.st_mtime_ns, after.st_ino) == (before.st_mtime_ns, before.st_ino)
    path.write_bytes(path.read_bytes()[:1000])  # damaged: made again
    download_lpips(tmp_path, ["alex"], sources=sources)
    assert path.stat().st_size == before.st_size


def test_failures_are_one_line_and_leave_nothing(sources, served, tmp_path):
    folder, base = served
    heads = state_dicts("alex", sources["alex"])[1]
    bad_files = {
        "key": {k: v for k, v in heads.items() if k != "lin3.model.1.weight"},
        "nan": heads | {"lin3.model.1.weight": torch.full((1, 384, 1, 1), torch.nan)},
        "list": [1, 2],
        "code": heads | {"lin3.model.1.weight": print},  # weights_only refuses it
    }
    for name, content in bad_files.items():
        torch.save(content, folder / f"bad_{name}.pth")
    (folder / "cut.pth").write_bytes((folder / "alex.pth").read_bytes())
    cases = {
        f"{base}/absent.pth": "HTTP Error 404",
        f"{base}/cut.pth": "ends after",
        **{f"{base}/bad_{name}.pth": "not the weights" for name in bad_files},
    }
    for url, reason in cases.items():
        file = folder / url.rpartition("/")[2]
        sha256 = sha256_of(file) if file.exists() else ""
        bad = changed(sources, heads=url, heads_sha256=sha256)
        with pytest.raises(DataError) as caught:
            download_lpips(tmp_path / "cache", ["alex"], sources=bad)
        assert_one_line(caught.value, url, reason)
        assert list((tmp_path / "cache").iterdir()) == []
    other = changed(sources, heads_sha256=SOURCES["alex"].heads_sha256)
    with pytest.raises(DataError) as caught:
        download_lpips(tmp_path / "cache", ["alex"], sources=other)
    assert_one_line(caught.value, sources["alex"].heads, "not the file that was published")


def assert_one_line(error, url, reason):
    line = str(error)
    assert line.startswith(f"{url}: ")
    assert reason in line
    assert "lpips_alex.npz" in line
    assert "--lpips FOLDER" in line
    assert "\n" not in line
    assert len(line) < 500


def test_no_more_is_downloaded_than_weights_can_have(sources, tmp_path, monkeypatch):
    monkeypatch.setattr("sagesplat.download.weights.MAX_HEADS", 100)
    with pytest.raises(DataError, match=r"cannot be downloaded \(more than 0\.0001 MB\)"):
        download_lpips(tmp_path, ["alex"], sources=sources)
    assert list(tmp_path.iterdir()) == []
