"""The colours: told apart in grey, and by people who see two or one of three colours."""

import matplotlib
import numpy as np
import pytest

from goalgan_bt.viz import palette

# What people with one kind of cones missing see of linear red, green and blue (Machado, Oliveira
# and Fernandes 2009, severity 1): three rows each.
SEEN = {
    "all": "1 0 0  0 1 0  0 0 1",
    "without red": "0.152286 1.052583 -0.204868  0.114503 0.786281 0.099216  -0.003882 -0.048116 "
    "1.051998",
    "without green": "0.367322 0.860646 -0.227968  0.280085 0.672501 0.047413  -0.011820 0.042940 "
    "0.968881",
    "without blue": "1.255528 -0.076749 -0.178779  -0.078411 0.930809 0.147602  0.004733 0.691367 "
    "0.303900",
}


def lightness(rgb, kind="all"):
    """L* of CIELAB, 0 to 100, of colours (..., 3) of 0 to 255, as such people see them."""
    linear = np.asarray(rgb) / 255
    linear = np.where(linear <= 0.04045, linear / 12.92, ((linear + 0.055) / 1.055) ** 2.4)
    y = np.clip(linear @ np.array(SEEN[kind].split(), float).reshape(3, 3).T, 0, 1) @ [
        0.2126,
        0.7152,
        0.0722,
    ]
    return np.where(y > 0.008856, 116 * np.cbrt(y) - 16, 903.3 * y)


@pytest.mark.parametrize("kind", SEEN)
def test_success_grows_lighter_evenly_for_all_eyes(kind):
    """So that it is read in grey, too."""
    steps = np.diff(lightness(palette.colours(np.linspace(0, 1, 11)), kind))
    assert (steps > 3).all() and steps.max() < 4 * steps.min()
    dark, bright = lightness(palette.colours(np.array([0.0, 1.0])), kind)
    assert dark < 25 and bright > 80


def test_page_and_plots_have_the_same_colours():
    wanted = matplotlib.colormaps[palette.SUCCESS](np.linspace(0, 1, 101))[:, :3] * 255
    assert np.abs(palette.colours(np.linspace(0, 1, 101)) - wanted).max() < 6


def test_what_is_not_known_is_grey():
    (grey,) = palette.colours(np.array([np.nan]))
    assert grey[0] == grey[1] == grey[2]


@pytest.mark.parametrize("kind", SEEN)
def test_goals_differ_in_shape_and_in_lightness_from_their_rim(kind):
    goals = palette.GOALS.values()
    assert len({goal.shape for goal in goals}) == len({goal.marker for goal in goals}) == 3
    for goal in goals:
        assert abs(lightness(goal.fill, kind) - lightness(goal.rim, kind)) > 35
