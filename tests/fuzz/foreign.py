"""Which functions of the package read bytes, and which of them need no reader in tests/fuzz/readers.

A function reads bytes where it calls one of `CALLS`: the ways of Python and of our libraries to open, parse
or fetch, and those functions of io/ through which the rest of the package reads.
tests/test_fuzz_foreign.py runs every reader on a valid file, and fails where a function that reads is
neither run by one of them nor listed in `EXCEPTIONS`.
"""

import ast
from collections.abc import Iterator
from pathlib import Path

PACKAGE = Path(__file__).parents[2] / "src" / "sagesplat"
CALLS = {
    # files
    "open", "read_bytes", "read_text", "fromfile", "memmap", "loadtxt", "genfromtxt", "mmap",
    # what is in them
    "loads", "frombuffer", "unpack", "unpack_from", "iter_unpack", "decompress", "decompressobj", "reader",
    "DictReader", "ZipFile", "TarFile", "read_array", "fromstring", "literal_eval", "safe_load",
    # what others sent
    "urlopen", "urlretrieve", "snapshot_download", "hf_hub_download", "recv", "Headers",
    # networks and weights
    "InferenceSession", "from_pretrained", "load_file", "safe_open",
    # our own
    "read_json", "read_json_as", "parse_json_as", "known_json", "read_toml",
    "Npz", "read_columns", "read_header", "parse_header",
}  # fmt: skip
LOADERS = {"np", "numpy", "torch", "json", "tomllib", "pickle", "image"}  # whose `load` reads a file
WRITING = set("wxa")

OURS = "what this version of the package installed"
_WROTE = "what this process wrote a moment ago"
MACHINE = "what the operating system says"
_COLMAP = "what COLMAP's process of ours wrote; it ends alone, and its error is one line"
_NETWORK = "a network that the user names, by its authors' library, told to run no code and read no pickles"
_HASHED = "bytes that are only hashed, compared, copied or sent"
EXCEPTIONS: dict[str, str] = {
    "cli.__init__:main": MACHINE,
    "cli.help:_classes": OURS,
    "cli.overview:summaries": OURS,
    "core.signals:answered_at_once.watch": _WROTE,
    "demo.capture:cached_capture": OURS,
    "download.scenes:read_registry": OURS,
    "formats.increments:as_increment": _WROTE,
    "formats.sog_write:archived": _WROTE,
    "formats.stream:encode_stream": _WROTE,
    "formats.levels:select_level": "columns of a level that read_level has read",
    "formats.offsets:write_doubles": _WROTE,
    "formats.ply:select_ply": "rows of a PLY that read_ply_splat has read",
    "io.lock:_exclusive": _HASHED,
    "io.lock:_open": _HASHED,
    "kernels.jit:_file_hash": OURS,
    "output.report:template": OURS,
    "run.ray_cluster:_check_answers": "nine bytes, of which one is compared",
    "run.remote:run_part": _HASHED,
    "run.stage:run_stages": _WROTE,
    "stages.api:FinishedRun.show": _WROTE,
    "stages.adopt:_label": "by read_header and read_level, which the readers run",
    "stages.adopt:_make_capture": _WROTE,
    "stages.live_bundle:_live_bundle": OURS,
    "stages.regroup:_headers": "by read_header of coded streams, which the readers run",
    "stages.regroup:_write_ladder": "by read_header of levels, which the readers run",
    "stages.nest:nest_levels.make": "by read_header and read_level, which the readers run",
    "scene._sfm:Stages._reasons": _COLMAP,
    "scene._sfm:Stages.features": _COLMAP,
    "scene._sfm:Stages.matches": _COLMAP,
    "scene._sfm:_result": _COLMAP,
    "scene._sfm:run": _COLMAP,
    "scene.photos:_ending": _COLMAP,
    "scene.photos:_run": _COLMAP,
    "segment.coco:": OURS,
    "segment.hub:folder_of": _NETWORK,
    "segment.hub:load_image_processor": _NETWORK,
    "segment.hub:load_model": _NETWORK,
    "segment.hub:load_tokenizer": _NETWORK,
    "segment.hub:read_config": _NETWORK,
    "segment.mask_networks:_Squared.__init__": _NETWORK,
    "segment.taxonomies:_vocabularies": OURS,
    "studies.compare.run:compare": _HASHED,
    "train.memory:_cgroup_limits": MACHINE,
    "stages.view:_ladder_of": "a manifest that view.is_bundle has read",
    "viewer.bundle:_name_files": OURS,
    "viewer.bundle:_put_up": OURS,
    "viewer.built:has_viewer": OURS,
    "viewer.bundle:verified_files": _HASHED,
    "viewer.manifest:_palettes": _HASHED,
    "viewer.bundle:write_documents": OURS,
    "viewer.single_file:_decoder": OURS,
    "viewer.single_file:_is_ours": _HASHED,
    "viewer.single_file:_page": OURS,
    "viewer.single_file:write_single_file": OURS,
    "train.checkpoint:_verify": _WROTE,
    "viewer.pack:write_pack": _WROTE,
}


def readers_in(package: Path = PACKAGE) -> Iterator[tuple[str, str, int]]:
    """Every (function, call, line) that reads, e.g. ("io.files:read_json", "json.loads", 202)."""
    for path in sorted(package.rglob("*.py")):
        module = ".".join(path.relative_to(package).with_suffix("").parts)
        yield from _calls(ast.parse(path.read_text(encoding="utf-8")), module, [])


def _calls(node: ast.AST, module: str, names: list[str]) -> Iterator[tuple[str, str, int]]:
    for child in ast.iter_child_nodes(node):
        inside = names
        if isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            inside = [*names, child.name]
        elif isinstance(child, ast.Call) and _reads(child):
            yield f"{module}:{'.'.join(names)}", ast.unparse(child.func), child.lineno
        yield from _calls(child, module, inside)


def _reads(call: ast.Call) -> bool:
    owner = call.func.value if isinstance(call.func, ast.Attribute) else None
    name = call.func.attr if isinstance(call.func, ast.Attribute) else getattr(call.func, "id", "")
    if name == "load":
        return isinstance(owner, ast.Name) and owner.id in LOADERS
    return name in CALLS and not (name == "open" and _no_reading(call, owner))


def _no_reading(call: ast.Call, owner: ast.expr | None) -> bool:
    """Whether what is called `open` writes, or opens a run's job or a browser."""
    modes = [a.value for a in call.args if isinstance(a, ast.Constant) and isinstance(a.value, str)]
    if any(set(mode) & WRITING and len(mode) <= 3 for mode in modes):
        return True
    owner_name = ast.unparse(owner) if owner is not None else ""
    return owner_name.endswith(("spec", "webbrowser")) or owner_name.startswith("_spec(")
