"""Draw the parts of the package in the layers of pyproject.toml, and the imports between them.

    python docs/house.py        # writes docs/pictures/house.svg

The arrows follow from the imports in the code. A test checks that the saved picture agrees with them.
"""

import pathlib
import textwrap
import tomllib
from typing import NamedTuple

import grimp

ROOT = pathlib.Path(__file__).parents[1]
PICTURE = ROOT / "docs" / "pictures" / "house.svg"
PART, GAP, RISE = 188, 22, 46  # width of a part, space beside it, space below a layer
TITLE, ROW, LETTERS = 32, 15, 31  # height of a part's name and of a row of modules; letters in such a row
INK, PAPER, LINE = "#1b2733", "#eef3f8", "#7d8fa1"


class Package(NamedTuple):
    layers: list[list[str]]  # the names of the parts, the top layer first
    modules: dict[str, list[str]]  # the modules of each part
    imports: list[tuple[str, str]]  # a part, and a part that it imports


def read() -> Package:
    """The layers that import-linter checks, and the imports between their parts."""
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    names = next(contract["layers"] for contract in contracts if contract["type"] == "layers")
    layers = [[name.strip() for name in line.split("|")] for line in names]
    graph = grimp.build_graph("beliefrl")
    modules: dict[str, list[str]] = {part: [] for layer in layers for part in layer}
    pairs = set()
    for module in sorted(graph.modules - {"beliefrl"}):
        part, _, name = module.removeprefix("beliefrl.").partition(".")
        if name:
            modules[part].append(name)
        for other in graph.find_modules_directly_imported_by(module):
            below = other.removeprefix("beliefrl.").partition(".")[0]
            if below in modules and below != part:
                pairs.add((part, below))
    return Package(layers, modules, sorted(pairs))


def draw(package: Package) -> str:
    """An SVG with a row for each layer, and arrows from each part to the parts that it imports (`sparse`)."""
    width = max(map(len, package.layers)) * (PART + GAP) + GAP
    rows = {part: textwrap.wrap(", ".join(modules), LETTERS) for part, modules in package.modules.items()}
    ends, shapes, y = {}, [], GAP
    for layer in package.layers:
        height = TITLE + max(len(rows[part]) for part in layer) * ROW + 8
        left = (width - len(layer) * (PART + GAP) + GAP) / 2
        for column, part in enumerate(layer):
            x = left + column * (PART + GAP)
            ends[part] = x + PART / 2, y, y + height
            shapes.append(
                f'<rect x="{x:g}" y="{y}" width="{PART}" height="{height}" rx="6" fill="{PAPER}" stroke="{INK}"/>'
            )
            shapes.append(f'<text x="{x + PART / 2:g}" y="{y + 23}" font-size="16" font-weight="600">{part}</text>')
            for number, row in enumerate(rows[part], 1):
                shapes.append(f'<text x="{x + PART / 2:g}" y="{y + 25 + number * ROW}" font-size="11">{row}</text>')
        y += height + RISE
    arrows = []
    for part, below in sparse(package.imports):
        (x0, _, start), (x1, end, _) = ends[part], ends[below]
        middle = (start + end - 3) / 2
        curve = f"M{x0:g} {start} C{x0:g} {middle:g} {x1:g} {middle:g} {x1:g} {end - 3}"
        arrows.append(f'<path d="{curve}" fill="none" stroke="{LINE}" stroke-width="1.5" marker-end="url(#head)"/>')
    height = y - RISE + GAP
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" height="{height}" '
        f'font-family="sans-serif" text-anchor="middle" fill="{INK}">'
        '<defs><marker id="head" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="8" markerHeight="8" orient="auto">'
        f'<path d="M0 0 L8 4 L0 8 z" fill="{LINE}"/></marker></defs>'
        f'<rect width="{width}" height="{height}" fill="white"/>'
    )
    return "\n".join([head, *arrows, *shapes, "</svg>", ""])


def sparse(imports: list[tuple[str, str]]) -> list[tuple[str, str]]:
    """Omit the pairs that follow from others: `commands` imports `training`, which imports `types`."""
    direct = {}
    for part, below in imports:
        direct.setdefault(part, set()).add(below)

    def reaches(part: str, target: str) -> bool:
        return any(below == target or reaches(below, target) for below in direct.get(part, ()))

    return [(a, b) for a, b in imports if not any(c != b and reaches(c, b) for c in direct[a])]


if __name__ == "__main__":
    PICTURE.write_text(draw(read()))
    print(PICTURE)
