"""The measured tables of the documents, the oldest first, with the commits to the code since.

python -m tools.doc_tables
"""

import re
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import date
from pathlib import Path

_MEASURED = 6  # numbers with a decimal point: a table with fewer explains, and measures nothing
_COMMIT = re.compile(r"(?<=commit )[0-9a-f]{7}\b|\b(?=[a-f]*\d)[0-9a-f]{7}\b")
_DATE = re.compile(r"\b20\d\d-\d\d-\d\d\b")


@dataclass(frozen=True)
class Table:
    """A table with measured figures."""

    page: str
    line: int
    title: str  # of its section
    measured: date | None
    commit: str | None  # as the section says, seven digits
    command: bool  # whether its page names one


def tables(docs: Path) -> Iterator[Table]:
    """All of them; date and commit are those that their section or one above it says."""
    for path in sorted(docs.rglob("*.md")):
        text = path.read_text()
        command = re.search(
            r"(?:^ {4}|`|^)(?:sagesplat|python -m benchmarks|node web/test)\b", text, re.MULTILINE
        )
        above: list[tuple[int, str]] = []
        parts = re.split(r"^(#{1,6} .*)\n", text, flags=re.MULTILINE)
        line = parts[0].count("\n") + 1
        for title, body in zip(parts[1::2], parts[2::2], strict=True):
            depth = len(title) - len(title.lstrip("#"))
            above = [section for section in above if section[0] < depth] + [(depth, body)]
            said = "\n".join(section for _, section in above)
            dates, commits = _DATE.findall(said), _COMMIT.findall(said)
            for found in re.finditer(r"(?:^\|.*\n)+", body, re.MULTILINE):
                if _is_measured(found[0]):
                    yield Table(
                        str(path.relative_to(docs)), line + 1 + body[: found.start()].count("\n"),
                        title.lstrip("# "), date.fromisoformat(dates[-1]) if dates else None,
                        commits[-1] if commits else None, command is not None,
                    )  # fmt: skip
            line += 1 + body.count("\n")


def _is_measured(table: str) -> bool:
    rows = re.sub(r"`[^`]*`|[A-Za-z]-\d\.\d", "", "\n".join(table.splitlines()[2:]))
    return not re.match(r"\| *flag", table) and len(re.findall(r"\d\.\d", rows)) >= _MEASURED


def ages(docs: Path, today: date) -> str:
    """A line for each table, the oldest first: its age, and the commits to the code since."""
    since: dict[str, str] = {}
    lines = []
    for table in sorted(tables(docs), key=lambda t: t.measured or date.min):
        if table.commit and table.commit not in since:
            command = ["git", "rev-list", "--count", f"{table.commit}..HEAD", "--", ":/src"]
            done = subprocess.run(command, cwd=docs, capture_output=True, text=True, check=False)
            since[table.commit] = done.stdout.strip() or "?"
        age = f"{(today - table.measured).days:5} days" if table.measured else "  no date "
        changes = f"{since[table.commit]:>5} commits" if table.commit else "   no commit"
        lines.append(f"{age} {changes}  {table.page}:{table.line}  {table.title}")
    return "\n".join(lines)


if __name__ == "__main__":
    print(ages(Path("docs"), date.today()))
