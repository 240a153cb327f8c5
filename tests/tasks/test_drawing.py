"""Shapes land where they are said to be, in their colours."""

import numpy as np
import pytest

from beliefrl.tasks.drawing import BLUE, GREEN, RED, Circle, Line, Picture, Polygon, paint

COLOURS = {RED: (200, 85, 61), GREEN: (75, 148, 96), BLUE: (42, 111, 158)}


def picture(*shapes):
    """One pixel is one unit."""
    return paint(Picture((-10.0, -20.0), (30.0, 40.0), shapes, pixels=60))


def at(pixels, x, y):
    return tuple(int(part) for part in pixels[39 - y, x + 10])


@pytest.mark.parametrize("colour", COLOURS)
@pytest.mark.parametrize(
    ("shape", "inside", "outside"),
    [
        (lambda c: Circle((5, 10), 4.0, c), [(5, 10), (5, 12), (2, 10)], [(5, 15), (9, 13)]),
        (lambda c: Line([(0, 0), (20, 0), (20, 30)], 4.0, c), [(10, 1), (20, 20), (-1, 0)], [(10, 3), (10, 10)]),
        (lambda c: Line([(5, 10)], 4.0, c), [(5, 10)], [(5, 13)]),
        (lambda c: Polygon([(0, 0), (20, 0), (0, 20)], c), [(2, 2), (2, 16), (16, 2)], [(12, 12), (-2, 2)]),
    ],
    ids=["circle", "line", "dot", "polygon"],
)
def test_a_shape_is_where_it_is_said_to_be(shape, inside, outside, colour):
    pixels = picture(shape(colour))
    assert {at(pixels, *point) for point in inside} == {COLOURS[colour]}
    assert {at(pixels, *point) for point in outside} == {at(picture(), 0, 0)}


def test_the_last_shape_is_uppermost():
    pixels = picture(Circle((0, 0), 5.0, RED), Circle((0, 0), 2.0, GREEN))
    assert (at(pixels, 0, 0), at(pixels, 3, 0)) == (COLOURS[GREEN], COLOURS[RED])


@pytest.mark.parametrize("angle", [0.0, 0.3, np.pi / 4, 1.2])
def test_a_line_is_as_wide_as_it_is_said_to_be_in_every_direction(angle):
    end = 8 * np.array([np.cos(angle), np.sin(angle)])
    pixels = paint(Picture((-10.0, -10.0), (10.0, 10.0), [Line([-end, end], 3.0, "black")], pixels=200))
    area = np.sum(1 - pixels[..., 0] / pixels.max()) * 0.1**2
    assert area == pytest.approx(16 * 3 + np.pi * 1.5**2, rel=0.02)


def test_both_sides_are_even_and_the_longer_one_is_as_asked_for():
    assert paint(Picture((0.0, 0.0), (3.0, 1.0), [], pixels=100)).shape == (34, 100, 3)
