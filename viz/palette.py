"""The colours and shapes of page, plots, films and exports, told apart in any light.

Success is viridis: dark for never, bright for always, each step as far from the next to the eye, in
grey and for the colour-blind as well. Goals differ in shape, rim and lightness, not in hue alone.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from goalgan_bt.envs.maze import FloatArray

RGB = tuple[int, int, int]

SUCCESS = "viridis"  # as matplotlib calls it
STOPS = np.array(  # of it, evenly spread
    [
        *([68, 1, 84], [72, 24, 106], [71, 45, 123], [66, 64, 134], [59, 82, 139]),
        *([51, 99, 141], [44, 114, 142], [38, 130, 142], [33, 145, 140], [31, 160, 136]),
        *([40, 174, 128], [63, 188, 115], [94, 201, 98], [132, 212, 75], [173, 220, 48]),
        *([216, 226, 25], [253, 231, 37]),
    ]
)
UNKNOWN = 150  # grey, where nothing is known


class Goal(NamedTuple):
    """How goals of one kind are drawn: shape as viser calls it, marker as matplotlib does."""

    text: str
    fill: RGB
    rim: RGB
    shape: str
    marker: str


GOALS = {  # by label
    -1: Goal("too hard", (214, 69, 65), (255, 255, 255), "diamond", "D"),
    0: Goal("intermediate", (255, 255, 255), (20, 20, 20), "circle", "o"),
    1: Goal("too easy", (150, 158, 172), (20, 20, 20), "square", "s"),
}
RUNS = (  # one each, and curves
    *("#3b7dd8", "#e8871e", "#4aa564", "#c2416b", "#8a63c9", "#7a7a7a", "#17a2b8", "#b5a400"),
    *("#7fb2f0", "#f4b678", "#8fd19e", "#e58fac", "#c4aee8", "#b8b8b8", "#8fd9e6", "#8c5a3c"),
)


def colours(rate: FloatArray) -> NDArray[np.uint8]:
    """Success in [0, 1], (...), as RGB (..., 3); grey where it is not known."""
    rate = np.asarray(rate, dtype=float)
    stops = np.linspace(0, 1, len(STOPS))
    rgb = np.stack([np.interp(rate, stops, channel) for channel in STOPS.T], axis=-1)
    rgb[~np.isfinite(rate)] = UNKNOWN
    return rgb.round().astype(np.uint8)


def css(colour: RGB) -> str:
    """A colour as a browser reads it, and matplotlib."""
    return "#" + "".join(f"{channel:02x}" for channel in colour)
