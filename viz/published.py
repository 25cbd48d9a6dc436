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


def published(settings: dict[str, Any]) -> tuple[Published, ...]:
    """What was published for the task of these settings; with a map of one's own it is another."""
    return PUBLISHED.get(str(settings.get("env")), ()) if settings.get("map") is None else ()
