"""A short tour of the page: what one sees, in five stops, for who has never seen it."""

from typing import NamedTuple


class Stop(NamedTuple):
    """A title, a text in markdown, and the layers that are shown meanwhile."""

    title: str
    text: str
    layers: tuple[str, ...]


TOUR = (
    Stop(
        "The floor",
        "A body shall learn to walk from the blue ball to **any** place of this maze. Each square "
        "of the floor is such a place: dark where the body never gets, bright where it always "
        "does. While it learns, the bright part grows.",
        ("coverage", "walls"),
    ),
    Stop(
        "The goals",
        "Nobody tells it what to practise. A network (the GAN) imagines goals that are neither "
        "hopeless nor mastered: the white **circles**. Squares have become too easy, diamonds are "
        "still too hard. They move outward as it learns.",
        ("coverage", "walls", "goals"),
    ),
    Stop(
        "The body",
        "It goes for the pink **ring**, at real speed, and leaves a red trail. Its only reward "
        "in training is 1 for coming into the ring, and nothing before.",
        ("coverage", "walls", "body"),
    ),
    Stop(
        "The way back",
        "A second model remembers which place was reached from which, and recalls backward from "
        "the goal how one may come to it: the pink **arrows** (straight to the goal where it knows "
        "no way). The body sees the arrow where it stands, but not the map.",
        ("walls", "body", "ways"),
    ),
    Stop(
        "Your turn",
        "**Click on the floor**: the body tries to get there, and the panel says how that ended "
        'and how often this place is reached. Under "Time" you can go back to the beginning, '
        'under "Curves" are the figures.',
        ("coverage", "walls", "goals", "body", "ways", "traces", "tried"),
    ),
)
