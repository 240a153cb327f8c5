"""Draws the package as a house: its rooms by the layers of pyproject.toml, and which room imports which.

    python docs/house.py        # writes docs/pictures/house.svg

The arrows are read from the code's own imports. A test holds the kept picture to them.
"""

import pathlib
import textwrap
import tomllib
from typing import NamedTuple

import grimp

ROOT = pathlib.Path(__file__).parents[1]
PICTURE = ROOT / "docs" / "pictures" / "house.svg"
ROOM, GAP, RISE = 188, 22, 46  # width of a room, space beside it, space below a storey
TITLE, ROW, LETTERS = 32, 15, 31  # height of a room's name and of a row of modules; letters in such a row
INK, PAPER, LINE = "#1b2733", "#eef3f8", "#7d8fa1"


class House(NamedTuple):
    storeys: list[list[str]]  # the names of rooms, the top storey first
    modules: dict[str, list[str]]  # the modules of each room
    imports: list[tuple[str, str]]  # a room and one that it imports


def read() -> House:
    """The layers that import-linter holds, and the imports between them."""
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    layers = next(contract["layers"] for contract in contracts if contract["type"] == "layers")
    storeys = [[name.strip().removeprefix("beliefrl.") for name in layer.split("|")] for layer in layers]
    graph = grimp.build_graph("beliefrl")
    modules: dict[str, list[str]] = {room: [] for storey in storeys for room in storey}
    pairs = set()
    for module in sorted(graph.modules - {"beliefrl"}):
        room, _, name = module.removeprefix("beliefrl.").partition(".")
        if name:
            modules[room].append(name)
        for other in graph.find_modules_directly_imported_by(module):
            below = other.removeprefix("beliefrl.").partition(".")[0]
            if below in modules and below != room:
                pairs.add((room, below))
    return House(storeys, modules, sorted(pairs))


def draw(house: House) -> str:
    """The house as SVG: a row for each storey, and an arrow from each room to those that it imports (`sparse`)."""
    width = max(map(len, house.storeys)) * (ROOM + GAP) + GAP
    rows = {room: textwrap.wrap(", ".join(modules), LETTERS) for room, modules in house.modules.items()}
    ends, shapes, y = {}, [], GAP
    for storey in house.storeys:
        height = TITLE + max(len(rows[room]) for room in storey) * ROW + 8
        left = (width - len(storey) * (ROOM + GAP) + GAP) / 2
        for column, room in enumerate(storey):
            x = left + column * (ROOM + GAP)
            ends[room] = x + ROOM / 2, y, y + height
            shapes.append(
                f'<rect x="{x:g}" y="{y}" width="{ROOM}" height="{height}" rx="6" fill="{PAPER}" stroke="{INK}"/>'
            )
            shapes.append(f'<text x="{x + ROOM / 2:g}" y="{y + 23}" font-size="16" font-weight="600">{room}</text>')
            for number, row in enumerate(rows[room], 1):
                shapes.append(f'<text x="{x + ROOM / 2:g}" y="{y + 25 + number * ROW}" font-size="11">{row}</text>')
        y += height + RISE
    arrows = []
    for room, below in sparse(house.imports):
        (x0, _, start), (x1, end, _) = ends[room], ends[below]
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
    """Without the pairs that a path over another room implies: `commands` reaches `types` through `training`."""
    direct = {}
    for room, below in imports:
        direct.setdefault(room, set()).add(below)

    def reaches(room: str, target: str) -> bool:
        return any(below == target or reaches(below, target) for below in direct.get(room, ()))

    return [(a, b) for a, b in imports if not any(c != b and reaches(c, b) for c in direct[a])]


if __name__ == "__main__":
    PICTURE.write_text(draw(read()))
    print(PICTURE)
