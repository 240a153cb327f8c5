"""Errors for mistakes of a user, and functions that quote text from elsewhere in a message. Imports nothing slow."""

import re
from typing import Any

ESCAPES = re.compile(r"(?:\x1b\[|\x9b)[0-?]*[ -/]*[@-~]|\x1b\].*?(?:\x07|\x1b\\)", re.DOTALL)  # colours, titles, links


class UserError(Exception):
    """A mistake that the user can fix. Its message is one sentence: what was wrong, and what to do."""


class Fault(UserError):
    """An environment misbehaved. The message names the environment, the seed and the step."""

    seeds: Any = None  # of a training: the seeds as trained until then (`host_loop`)
    step: int = 0
    stretch: Any = None


class OfCallback(Exception):
    """Wraps an OSError that a function of the user raised, since other OSErrors are taken for those of the folder."""


def cause(error: OSError) -> str:
    """The operating system's reason for an error, or else the error's own text."""
    return error.strerror or one_line(str(error))


def said(error: BaseException) -> str:
    """The type and message of an exception of other code, on one line, without control characters."""
    text = one_line(str(error))[:300].rstrip(".")
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


def one_line(text: str) -> str:
    """Text from elsewhere on one line, without terminal escapes and other control characters."""
    text = " ".join(ESCAPES.sub("", text).split())
    return "".join(character for character in text if character.isprintable())


def short(value: Any) -> str:
    """The repr of a value, on one line of at most 80 characters."""
    text = one_line(repr(value))
    return text if len(text) <= 80 else f"{text[:77]}..."
