"""A table: rows that print as text, CSV, Markdown and LaTeX."""

import csv
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from sagesplat.core.events import TableMade
from sagesplat.io.columns import text_cell
from sagesplat.io.files import atomic_path, write_text


@dataclass(frozen=True)
class Table:
    """Rows under a header; `formats` holds a format spec per column for people, the CSV keeps every digit.

    The spec "k" writes large counts short (141k, 1.4M).
    """

    title: str
    header: tuple[str, ...]
    formats: tuple[str, ...]
    rows: Sequence[tuple[str | int | float, ...]]
    groups: tuple[tuple[str, int], ...] = ()  # (title, columns) over the header, from its second column on
    marks: Mapping[tuple[int, int], str] = field(default_factory=dict)  # (row, column): a note to the cell
    notes: tuple[str, ...] = ()  # under the table

    def only(self, *names: str) -> "Table":
        """Some of its columns, without groups and marks."""
        picked = [self.header.index(name) for name in names]
        rows = [tuple(row[i] for i in picked) for row in self.rows]
        return Table(self.title, names, tuple(self.formats[i] for i in picked), rows)

    @property
    def event(self) -> TableMade:
        """What shows the table to whom listens."""
        return TableMade(self.title, self.header, tuple(map(tuple, self.cells())))

    def cells(self) -> list[list[str]]:
        """The rows as text; NaN reads as a dash."""
        return [[_text(v, spec) for v, spec in zip(row, self.formats, strict=True)] for row in self.rows]

    def columns(self) -> list[str]:
        """The header in one line, with the titles of groups before it."""
        groups = [title for title, span in self.groups for _ in range(span)]
        groups = ["", *groups, *[""] * (len(self.header) - 1 - len(groups))]
        return [f"{group} {name}".strip() for group, name in zip(groups, self.header, strict=True)]

    def write_csv(self, path: Path) -> None:
        """A header, then one line per row; NaN is an empty cell, marks are a last column.

        Text that a spreadsheet would take for a formula begins with a ' (`io.columns.text_cell`).
        """
        notes = [""] * len(self.rows)
        for (row, column), mark in sorted(self.marks.items()):
            notes[row] += f"{'; ' if notes[row] else ''}{self.columns()[column]}: {mark}"
        lines: list[list[str | int | float]] = [[*self.columns(), *(["marks"] if self.marks else [])]]
        for row, note in zip(self.rows, notes, strict=True):
            lines.append([*("" if _is_nan(v) else v for v in row), *([note] if self.marks else [])])
        with (
            atomic_path(path) as temporary,
            # of a path that is not UTF-8, in an error that a table holds, escapes are written
            temporary.open("w", newline="", encoding="utf-8", errors="backslashreplace") as file,
        ):
            cells = ([text_cell(v) if isinstance(v, str) else v for v in line] for line in lines)
            csv.writer(file).writerows(cells)

    def markdown(self) -> str:
        """The table in Markdown; marked cells are bold and carry their mark."""
        columns = [markdown_text(name) for name in self.columns()]
        rules = ["---:" if spec else "---" for spec in self.formats]
        lines = [f"| {' | '.join(columns)} |", f"|{'|'.join(rules)}|"]
        for r, cells in enumerate(self.cells()):
            shown = [
                f"**{markdown_text(cell)}** ({markdown_text(self.marks[r, c])})"
                if (r, c) in self.marks
                else markdown_text(cell)
                for c, cell in enumerate(cells)
            ]
            lines.append(f"| {' | '.join(shown)} |")
        return "\n".join([*lines, "", *map(markdown_text, self.notes)]).rstrip() + "\n"

    def latex(self) -> str:
        """The table in LaTeX (packages booktabs and, where cells are marked, xcolor with option `table`)."""
        alignment = "".join("r" if spec else "l" for spec in self.formats)
        lines = [r"\begin{table}", r"\centering", rf"\caption{{{_tex(self.title)}}}"]
        lines += [rf"\begin{{tabular}}{{{alignment}}}", r"\toprule"]
        if self.groups:
            heads, rules, column = [""], [], 2
            for title, span in self.groups:
                heads.append(rf"\multicolumn{{{span}}}{{c}}{{{_tex(title)}}}")
                rules.append(rf"\cmidrule(lr){{{column}-{column + span - 1}}}")
                column += span
            heads += [""] * (len(self.header) + 1 - column)
            lines += [" & ".join(heads) + r" \\", " ".join(rules)]
        lines += [" & ".join(map(_tex, self.header)) + r" \\", r"\midrule"]
        for r, cells in enumerate(self.cells()):
            shown = [
                rf"\cellcolor{{black!10}}{_tex(cell)}\textsuperscript{{{_tex(self.marks[r, c])}}}"
                if (r, c) in self.marks
                else _tex(cell)
                for c, cell in enumerate(cells)
            ]
            lines.append(" & ".join(shown) + r" \\")
        lines += [r"\bottomrule", r"\end{tabular}"]
        lines += [rf"\par\smallskip\footnotesize {_tex(note)}" for note in self.notes]
        return "\n".join([*lines, r"\end{table}", ""])

    def write(self, stem: Path) -> None:
        """The table as `stem`.csv, .md and .tex."""
        self.write_csv(stem.with_name(stem.name + ".csv"))
        write_text(stem.with_name(stem.name + ".md"), f"**{markdown_text(self.title)}**\n\n{self.markdown()}")
        write_text(stem.with_name(stem.name + ".tex"), self.latex())


def _is_nan(value: str | int | float) -> bool:
    return isinstance(value, float) and math.isnan(value)


def _text(value: str | int | float, spec: str) -> str:
    if _is_nan(value):
        return "–"
    if spec == "k":
        number = float(value)
        if number >= 1e4:
            return f"{number / 1e6:.1f}M" if number >= 1e6 else f"{number / 1e3:.0f}k"
        return f"{number:,.0f}"
    return format(value, spec)


_TEX = {c: "\\" + c for c in "&%$#_{}"} | {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}"}
_TEX |= {"^": r"\textasciicircum{}", "–": "--", "≥": r"$\geq$", "<": r"$<$", ">": r"$>$", "|": r"$|$"}


def _tex(text: str) -> str:
    """Text with LaTeX's own characters taken as they are."""
    shown = "".join(_TEX.get(character, character) for character in text)
    # the end of a row and a rule take a star or brackets after them for themselves
    return f"{{{shown[0]}}}{shown[1:]}" if shown[:1] in ("[", "*") else shown


def markdown_text(text: str) -> str:
    """Text for Markdown, in which its own characters and those of HTML are taken as they are."""
    text = text.replace("&", "&amp;").replace("<", "&lt;")
    return re.sub(r"[\\|`*\[\]~$]|(?<!\w)_|_(?!\w)", r"\\\g<0>", text)
