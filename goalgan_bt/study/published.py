"""Coverage that was published before, to be drawn beside ours."""

from typing import Any, NamedTuple


class Published(NamedTuple):
    """method: whose; points: (environment steps of training, coverage), read off its figures."""

    method: str
    points: tuple[tuple[float, float], ...]

    @property
    def last(self) -> tuple[float, float]:
        """Steps and coverage at its end."""
        return self.points[-1]


# Goal GAN without and with recall traces, Goyal et al. 2019, figures 5 and 6.
PUBLISHED = {
    "ant_umaze": (
        Published("Goal GAN", ((2.5e6, 0.20), (45e6, 0.48), (137e6, 0.63))),
        Published("recall traces", ((2.5e6, 0.22), (28e6, 0.48), (77e6, 0.64))),
    ),
    "point_umaze": (
        Published("Goal GAN", ((0.5e6, 0.20), (3e6, 0.68), (6e6, 0.78))),
        Published("recall traces", ((0.5e6, 0.30), (3e6, 0.78), (4e6, 0.96))),
    ),
}

# Goal GAN, and a GAN of all places visited, after 100 iterations of 100,000 steps, by dimension:
# Florensa et al. 2018.
POINT_ND = {
    "2": (1.0, 0.99),
    "3": (1.0, 0.86),
    "4": (1.0, 0.42),
    "5": (0.99, 0.33),
    "6": (0.9, 0.13),
}


def published(settings: dict[str, Any]) -> tuple[Published, ...]:
    """What was published for the task of these settings; with a map of one's own it is another."""
    env = str(settings.get("env"))
    if env == "point_nd":
        levels = POINT_ND.get(str(settings.get("dim")), ())
        names = "Goal GAN", "GAN fit all"
        return tuple(Published(name, ((10e6, y),)) for name, y in zip(names, levels, strict=False))
    return PUBLISHED.get(env, ()) if settings.get("map") is None else ()
