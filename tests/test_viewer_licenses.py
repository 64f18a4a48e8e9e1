"""The licences beside the viewer name everything that is in it."""

import re
from pathlib import Path

import sagesplat.viewer

STATIC = Path(sagesplat.viewer.__file__).parent / "static"


def test_each_crate_in_the_webassembly_has_its_notice() -> None:
    (module,) = (path.read_bytes() for path in (STATIC / "assets").glob("*.wasm"))
    # panics name the source file that they come from
    of_cargo = rb"/registry/src/[^/]+/([A-Za-z0-9_-]+)-(\d+\.\d+\.\d+)/"
    of_std = rb"/rust/deps/([A-Za-z0-9_-]+)-(\d+\.\d+\.\d+)/"
    crates = {
        f"{name.decode()} {version.decode()}"
        for pattern in (of_cargo, of_std)
        for name, version in re.findall(pattern, module)
    }
    assert len(crates) > 15
    notices = (STATIC / "THIRD_PARTY_LICENSES.txt").read_text("utf-8")
    assert sorted(name for name in crates if f"\n{name} (" not in notices) == []
    assert "\nthe Rust standard library (" in notices
    named = re.findall(r"^([a-z0-9_-]+ \d+\.\d+\.\d+) \(", notices, re.MULTILINE)
    assert set(named) == crates, "web/wasm-notices.txt lists crates that are not in it any more"


def test_a_notice_has_a_holder_and_the_text_of_its_licence() -> None:
    notices = (STATIC / "THIRD_PARTY_LICENSES.txt").read_text("utf-8").partition("Rust crates inside")[2]
    lines = notices.splitlines()
    for number, line in enumerate(lines):
        if re.match(r"[a-z0-9_-]+ \d+\.\d+\.\d+ \(", line):
            assert lines[number + 1].startswith("    "), line
    assert "Permission is hereby granted, free of charge" in notices
    assert "This notice may not be removed or altered from any source distribution." in notices
