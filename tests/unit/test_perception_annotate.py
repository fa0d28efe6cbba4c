"""Text in pictures can be read: each letter stands by itself, in a small picture too."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from graderd.perception.annotate import WHITE, text_on

LETTERS = {"LEFT": 4, "CENTER": 6, "RIGHT": 5, "1.4": 3, "UNKNOWN": 7}
"""Words, and of how many parts each is that do not touch."""


@pytest.mark.parametrize("text", LETTERS)
@pytest.mark.parametrize("size", [0.3, 0.5, 0.7, 1.0])
def test_letters_do_not_run_together(text: str, size: float) -> None:
    picture = np.full((60, 300, 3), 120, np.uint8)
    text_on(picture, text, (10, 45), size)
    bright = np.all(picture > 185, axis=2).astype(np.uint8)
    assert picture.max() == WHITE[0]
    assert cv2.connectedComponents(bright, connectivity=4)[0] - 1 == LETTERS[text]
