"""Tables as files: Markdown for reading and LaTeX for print. No file is left half written."""

import pathlib
from collections.abc import Sequence
from typing import NamedTuple

from beliefrl.runs.arrays import write_whole
from beliefrl.types import UserError, cause


class Column(NamedTuple):
    heading: str
    is_number: bool = False  # aligned right


Cells = Sequence[str]


def measure_text(name: str, value: float | None) -> str:
    """A measure of episodes as text; success is a rate. A diverged seed has None."""
    if value is None:
        return "diverged"
    return f"{value:.0%}" if name == "success" else f"{value:.4g}"


def markdown(columns: Sequence[Column], rows: Sequence[Cells]) -> str:
    """The table in Markdown."""
    cells = [[cell.replace("|", r"\|") for cell in row] for row in rows]
    lines = [[column.heading for column in columns], ["---:" if column.is_number else "---" for column in columns]]
    return "".join(f"| {' | '.join(line)} |\n" for line in (*lines, *cells))


def latex(columns: Sequence[Column], rows: Sequence[Cells]) -> str:
    """The table in LaTeX; it needs the package booktabs."""

    def line(cells: Cells) -> str:
        kept = (cell.replace("_", r"\_").replace("%", r"\%").replace("±", r"$\pm$") for cell in cells)
        return "    " + " & ".join(kept) + r" \\"

    alignment = "".join("r" if column.is_number else "l" for column in columns)
    head = [rf"\begin{{tabular}}{{{alignment}}}", r"    \toprule", line([column.heading for column in columns])]
    foot = [r"    \bottomrule", r"\end{tabular}"]
    return "\n".join([*head, r"    \midrule", *map(line, rows), *foot]) + "\n"


def write_table(columns: Sequence[Column], rows: Sequence[Cells], out: pathlib.Path) -> pathlib.Path:
    """Write the table as .md and .tex; returns the path of the first.

    Raises:
        UserError: the files cannot be written.
    """
    try:
        write_whole(out.with_suffix(".tex"), latex(columns, rows).encode())
        write_whole(out.with_suffix(".md"), markdown(columns, rows).encode())
    except OSError as error:
        raise UserError(f"{out} cannot be written ({cause(error)}): choose another --out.") from None
    return out.with_suffix(".md")
