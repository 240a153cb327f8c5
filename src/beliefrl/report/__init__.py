"""A report on runs: one HTML page that needs no network and no server.

`data` computes the content; page.html, page.css, curves.js and page.js render it. The content is embedded as JSON. The
script inserts it as text, never as HTML, because the source of a run's folder may be untrusted. The page's
Content-Security-Policy enforces this: the browser runs no other script, and loads only pictures and videos from the
page's own location.
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
from beliefrl.errors import UserError
from beliefrl.report.data import page_data
from beliefrl.runs.cached import CachedRun
from beliefrl.runs.given_files import as_path, check_folder, write_given


def write_report(
    paths: Sequence[str | os.PathLike[str]] | str | os.PathLike[str],
    out: str | os.PathLike[str] = "report.html",
    unfinished: bool = False,
    note: Callable[[str], None] | None = None,
) -> pathlib.Path:
    """Write a report on all runs in these folders; returns the path of the page. An existing page is replaced.

    Runs that cannot be read and damaged lines of logs are left out. The page lists them.

    Args:
        paths: folders of runs, folders with runs at any depth, and files of results, NAME.json.gz; or one of them.
        out: the page, NAME.html. Its links to videos and pictures are relative to its folder.
        unfinished: whether curves and tables include unfinished runs.
        note: called with one sentence for each unreadable run, and for each log with damaged lines.

    Raises:
        UserError: there is no run in a folder, none of the runs can be read, or the page cannot be written.
    """
    out = as_path(out)
    if out.suffix not in (".html", ".htm"):
        raise UserError(f"{out} must end in .html, such as report.html.")
    if not isinstance(paths, str | os.PathLike) and not paths:
        raise UserError("There are no runs: give folders of runs, folders that contain runs, or files of results.")
    check_folder(out)
    found = find(paths, CachedRun)
    data = page_data(found.runs, out.parent, unfinished)
    left_out = data.pop("without_curve")
    content = page(data | {"damage": [*left_out, *found.damage]})
    write_given(out, content.encode())
    if note is not None:
        for sentence in found.damage:
            note(sentence)
    return out


def page(data: dict[str, Any]) -> str:
    """The HTML of the page that shows `data`."""
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
        data=_as_json(data | about),
    )


def _as_json(data: dict[str, Any]) -> str:
    """JSON that is safe inside a script element; numbers that are not finite become null."""
    finite = json.loads(json.dumps(data), parse_constant=lambda _: None)
    text = json.dumps(finite, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _hash(text: str) -> str:
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
