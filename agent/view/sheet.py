"""The paper that pictures of maps are drawn on: its colours, a sentence on top, a legend, things in a row."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]  # (H, W, 3) BGR
Colour = tuple[int, int, int]

PAPER: Colour = (250, 250, 250)
INK: Colour = (45, 40, 38)
FAINT: Colour = (150, 145, 140)
UNKNOWN: Colour = (226, 224, 222)
KNOWN_FREE: Colour = (255, 255, 255)
BLUE: Colour = (178, 95, 12)
ORANGE: Colour = (18, 112, 222)
GREEN: Colour = (70, 125, 20)
RED: Colour = (60, 30, 215)

WIDTH = 1600
GAP = 24
FONT = cv2.FONT_HERSHEY_DUPLEX


def stacked(parts: Sequence[Image]) -> Image:
    """One below the other, with air between."""
    gap = np.full((GAP, WIDTH, 3), PAPER, np.uint8)
    return np.vstack([piece for part in parts for piece in (gap, part)] + [gap])


def in_a_row(panels: Sequence[Image]) -> Image:
    """Panels of one width side by side."""
    sheet = np.full((max(panel.shape[0] for panel in panels), WIDTH, 3), PAPER, np.uint8)
    for i, panel in enumerate(panels):
        x = GAP + i * (panel.shape[1] + GAP)
        sheet[: panel.shape[0], x : x + panel.shape[1]] = panel
    return sheet


def centred(image: Image, width: int, above: int = 0) -> Image:
    """In the middle of a strip of paper."""
    side = (width - image.shape[1]) // 2
    right = width - image.shape[1] - side
    padded: Image = cv2.copyMakeBorder(image, above, 0, side, right, cv2.BORDER_CONSTANT, value=PAPER)
    return padded


def heading(verdict: str, figures: Sequence[str]) -> Image:
    """The sentence on top, and the numbers below it."""
    strip = np.full((62, WIDTH, 3), PAPER, np.uint8)
    write(strip, verdict, GAP, 26, 0.9, INK)
    write(strip, "   ".join(figures), GAP, 54, 0.5, INK)
    return strip


def legend(swatches: Sequence[tuple[Sequence[Colour], str]], note: str = "") -> Image:
    """What each colour means, and, fainter, what else there is to know."""
    strip = np.full((26, WIDTH, 3), PAPER, np.uint8)
    x = GAP
    for colours, text in swatches:
        for colour in colours:
            cv2.rectangle(strip, (x, 5), (x + 17, 21), colour, -1)
            cv2.rectangle(strip, (x, 5), (x + 17, 21), FAINT, 1)
            x += 18
        write(strip, text, x + 9, 18, 0.48, INK)
        x += 9 + text_width(text, 0.48) + 30
    write(strip, note, x, 18, 0.48, FAINT)
    return strip


def write(image: Image, text: str, x: int, y: int, size: float, colour: Colour) -> None:
    """A line of text that begins at x on the line y."""
    cv2.putText(image, text, (x, y), FONT, size, colour, 1, cv2.LINE_AA)


def text_width(text: str, size: float) -> int:
    return int(cv2.getTextSize(text, FONT, size, 1)[0][0])
