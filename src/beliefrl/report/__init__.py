"""Runs on one page of HTML that needs nothing else: no network, no server, no other file.

`data` says what is told; page.html, page.css, curves.js and page.js how it looks. The page's only content is JSON,
which the script puts in place as text, never as HTML: a run's folder may come from a stranger. The page's own policy
(Content-Security-Policy) holds the browser to that: no script but ours runs, and nothing is fetched but pictures and
videos from where the page lies.
"""

import base64
import hashlib
import html
import json
import os
import pathlib
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from importlib import metadata, resources
from string import Template
from typing import Any

from beliefrl.analysis.groups import find
from beliefrl.report.data import ReadOnce, told
from beliefrl.runs.arrays import write_whole
from beliefrl.types import UserError


def write_report(
    paths: Sequence[str | os.PathLike[str]],
    out: str | os.PathLike[str] = "report.html",
    unfinished: bool = False,
    note: Callable[[str], None] | None = None,
) -> pathlib.Path:
    """Write the report of all runs in these folders; returns the page's path. A page that is there is replaced.

    A run that cannot be read is left out, and so are damaged lines of a log; the page says so.

    Args:
        paths: folders that are runs or hold runs, however deep, and files of results, NAME.json.gz.
        out: the page, NAME.html. Links to videos and pictures are relative to where it lies.
        unfinished: runs that are not finished count as well.
        note: called with a sentence for each run that cannot be read, and for each log with damaged lines.

    Raises:
        UserError: there is no run in a folder, none of the runs can be read, or the page cannot be written.
    """
    out = pathlib.Path(out)
    if out.suffix not in (".html", ".htm"):
        raise UserError(f"The report is a page, which {out} is not called like: call it {out.with_suffix('.html')}.")
    if not os.path.isdir(out.parent):  # noqa: PTH112 - pathlib's raises where a name is too long
        raise UserError(f"There is no folder {out.parent} to write {out.name} into: make it, or choose another --out.")
    found = find(paths, ReadOnce)
    content = page(told(found.runs, out.parent, unfinished) | {"damage": found.damage})
    try:
        write_whole(out, content.encode())
    except OSError as error:
        raise UserError(f"{out} cannot be written ({error.strerror}): choose another --out.") from None
    if note is not None:
        for sentence in found.damage:
            note(sentence)
    return out


def page(data: dict[str, Any]) -> str:
    """The page that shows `data`."""
    files = resources.files(__name__)
    style, *scripts = ((files / name).read_text(encoding="utf-8") for name in ("page.css", "curves.js", "page.js"))
    script = "\n".join(scripts)
    about = {"made": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"), "version": metadata.version("beliefrl")}
    return Template((files / "page.html").read_text(encoding="utf-8")).substitute(
        style=style,
        style_hash=_hash(style),
        script=script,
        script_hash=_hash(script),
        title=html.escape(f"BeliefRL: {len(data['runs'])} runs"),
        data=_as_text(data | about),
    )


def _as_text(data: dict[str, Any]) -> str:
    """JSON that nothing in it can end or turn into HTML; for what is not a finite number it has no word but null."""
    finite = json.loads(json.dumps(data), parse_constant=lambda _: None)
    text = json.dumps(finite, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _hash(text: str) -> str:
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
