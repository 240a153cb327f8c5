"""Pictures of tasks: flat shapes in world coordinates, drawn with Pillow. No display is needed."""

import itertools
import math
import os
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageDraw

from beliefrl.errors import UserError, one_line

Point = Any  # (x, y) as a tuple or an array; x points right, y points up
Points = Any  # a sequence of points, or an array (points, 2)
SMOOTH = 3  # supersampling factor, as Pillow does not smooth edges

PAPER, PALE, GREY, INK = "#fbfaf7", "#e4e1d8", "#a9a79e", "#2f3a45"
RED, GREEN, BLUE = "#c8553d", "#4b9460", "#2a6f9e"


class Circle(NamedTuple):
    centre: Point
    radius: float
    colour: str


class Line(NamedTuple):
    """A line through one or more points, with round ends and corners."""

    points: Points
    width: float
    colour: str


class Polygon(NamedTuple):
    points: Points
    colour: str


class Picture(NamedTuple):
    """Shapes in world units, drawn in this order. Colours are those of Pillow, such as "#c8553d"."""

    low: Point  # world coordinates of the lower left corner
    high: Point  # world coordinates of the upper right corner
    shapes: Sequence[Circle | Line | Polygon]
    pixels: int = 480  # length of the longer side


def paint(picture: Picture) -> UInt8[np.ndarray, "height width 3"]:
    """The picture as pixels from 0 to 255, top row first. Width and height are even, as video encoders require."""
    low, high = np.asarray(picture.low, float), np.asarray(picture.high, float)
    scale = picture.pixels / np.max(high - low)
    width, height = 2 * np.ceil((high - low) * scale / 2 - 1e-6).astype(int)
    image = Image.new("RGB", (int(width) * SMOOTH, int(height) * SMOOTH), PAPER)
    canvas = ImageDraw.Draw(image)

    def place(points: Points) -> list[tuple[float, float]]:
        at = (np.asarray(points, float) - low) * scale * SMOOTH
        return [(float(x), image.height - float(y)) for x, y in at]

    def disc(x: float, y: float, radius: float, colour: str) -> None:
        canvas.ellipse((x - radius, y - radius, x + radius, y + radius), colour)

    def bar(points: list[tuple[float, float]], radius: float, colour: str) -> None:
        # Pillow's own thick lines are one pixel too narrow, and have flat ends.
        for (x0, y0), (x1, y1) in itertools.pairwise(points):
            length = math.hypot(x1 - x0, y1 - y0) or 1.0
            dx, dy = radius * (y1 - y0) / length, radius * (x0 - x1) / length
            canvas.polygon([(x0 + dx, y0 + dy), (x1 + dx, y1 + dy), (x1 - dx, y1 - dy), (x0 - dx, y0 - dy)], colour)
        for x, y in points:
            disc(x, y, radius, colour)

    for shape in picture.shapes:
        match shape:
            case Circle(centre, radius, colour):
                disc(*place([centre])[0], float(radius) * scale * SMOOTH, colour)
            case Line(points, width, colour):
                bar(place(points), float(width) * scale * SMOOTH / 2, colour)
            case Polygon(points, colour):
                canvas.polygon(place(points), colour)
    return np.array(image.reduce(SMOOTH))


class Viewer:
    """A window that shows one picture after another. Only one window can be open at a time."""

    def __init__(self, title: str):
        """Prepare a window, which opens with the first picture.

        Raises:
            UserError: pygame is not installed.
        """
        try:
            import pygame
        except ImportError:
            raise UserError("A window needs pygame: pip install 'beliefrl[render]'.") from None
        self._pygame, self._title, self._clock = pygame, title, pygame.time.Clock()

    def show(self, pixels: UInt8[np.ndarray, "height width 3"], fps: int | float) -> None:
        """Show a picture, at least 1 / fps seconds after the previous one.

        Raises:
            UserError: the window cannot be opened.
        """
        height, width, _ = pixels.shape
        screen = self._pygame.display.get_surface()
        if screen is None:
            screen = self._opened(width, height)
            self._pygame.display.set_caption(self._title)
        self._pygame.event.pump()  # otherwise the system considers the window unresponsive
        screen.blit(self._pygame.image.frombuffer(pixels.tobytes(), (width, height), "RGB"), (0, 0))
        self._pygame.display.flip()
        self._clock.tick(fps)

    def _opened(self, width: int, height: int) -> Any:
        display = self._pygame.display
        try:
            display.init()
            if display.get_driver() == "offscreen" and "SDL_VIDEODRIVER" not in os.environ:
                raise self._pygame.error("there is no display")  # SDL would draw where nobody sees it
            return display.set_mode((width, height))
        except self._pygame.error as error:
            raise UserError(f"A window cannot be opened ({one_line(str(error))}): write a video instead.") from None

    @property
    def is_closed(self) -> bool:
        """Whether the user has asked to close the window."""
        return self._pygame.display.get_init() and self._pygame.event.peek(self._pygame.QUIT)

    def close(self) -> None:
        self._pygame.display.quit()
