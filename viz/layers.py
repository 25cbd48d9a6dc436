"""What a page can show in its scene, and how it is told: names, legend, texts."""

from typing import NamedTuple

from goalgan_bt.viz import palette
from goalgan_bt.viz.palette import RGB, css

TRACE, OLD_TRACE = (255, 150, 0), (60, 25, 12)  # at the goal, and farthest back
PATH, MARK, TRAIL, START = (120, 120, 130), (255, 0, 170), (235, 30, 30), (70, 190, 255)


class Layer(NamedTuple):
    """Its name, what one is looking at, whether it is shown at first."""

    label: str
    hint: str
    shown: bool


GOALS = {  # a run whose policy learns to reach goals
    "coverage": Layer(
        "Coverage map",
        "The floor: how often the policy reaches each tile (0.5 m, larger in large mazes) from the "
        "start. Measured where the caption says so, otherwise the learner's own estimate from its "
        "recent episodes. A body that does not move covers the tiles around the start.",
        True,
    ),
    "goals": Layer(
        "Goals",
        "What the policy trains on now, imagined by the GAN: circles of intermediate difficulty, "
        "squares too easy, diamonds too hard; remembered ones are smaller. Those that lie in walls "
        "are left out.",
        True,
    ),
    "traces": Layer(
        "Recall traces",
        "Imagined by the backtracking model: bright at the goal, fading backward in time.",
        True,
    ),
    "ways": Layer(
        "Recalled ways",
        "Which way leads from each place to the goal that the body goes for, as the backtracking "
        "model over places recalls it; straight to it where it knows no way. The policy sees that "
        "direction.",
        True,
    ),
    "paths": Layer("Paths", "Where some of the last training episodes went.", False),
    "replay": Layer(
        "Replay memory",
        "Every goal that once was of intermediate difficulty; some are tried again.",
        False,
    ),
    "walls": Layer("Walls", "The maze, drawn low so that it hides nothing.", True),
    "body": Layer(
        "Body",
        "A policy on its way to a goal, at real speed, over and over: that of the report on show "
        "where the run has kept it, otherwise the newest. The trail is where it went.",
        True,
    ),
    "tried": Layer(
        "Tried",
        'What came of "Try all tiles": one attempt each, bright where it was reached.',
        True,
    ),
}
ROOMS = {  # a table of states
    "coverage": Layer(
        "Visits",
        "How often training has been in each cell so far, on a scale of logarithms.",
        True,
    ),
    "policy": Layer(
        "Policy", "Where the policy goes from each cell on average: longer is surer.", True
    ),
    "walls": Layer("Walls", "The four rooms, drawn low.", True),
}
RUNNING = {"body": Layer("Body", "The newest policy, at real speed, over and over.", True)}
OF_KIND = {"goals": GOALS, "rooms": ROOMS, "running": RUNNING}


def legend(kind: str) -> str:
    """Every colour, shape and line of a scene as HTML."""
    if kind == "running":
        return ""
    stops = ", ".join(
        f"{css(stop)} {100 * i / (len(palette.STOPS) - 1):.0f}%"
        for i, stop in enumerate(palette.STOPS.tolist())
    )
    low, high = ("never", "always reached") if kind == "goals" else ("never", "most visited")
    bar = (
        '<div style="display:flex;gap:8px;align-items:center">'
        f'<span>{low}</span><div style="flex:1;height:10px;border-radius:5px;background:'
        f'linear-gradient(90deg,{stops})"></div><span>{high}</span></div>'
    )
    if kind == "rooms":
        rows = [[("start", _dot(START)), ("goal", _ring()), ("the policy's way", _arrow())]]
    else:
        goals = [(goal.text, _shape(goal)) for goal in palette.GOALS.values()]
        rows = [
            [("Goals it practises (remembered: smaller)", ""), *goals],
            [("start", _dot(START)), ("goal of the body", _ring()), ("its trail", _line())],
            [("way to the ring, as recalled", _arrow()), ("recall trace", _line(TRACE))],
        ]
    words = "".join(
        "<div>"
        + " ".join(
            f'<span style="white-space:nowrap">{sign} {text}</span>&nbsp;' for text, sign in row
        )
        + "</div>"
        for row in rows
    )
    return f'<div style="font-size:12px;padding:4px 12px">{bar}{words}</div>'


def layers_of(kinds: list[str]) -> dict[str, Layer]:
    """What runs of these kinds can show; what is called otherwise in each has all names."""
    layers: dict[str, Layer] = {}
    for kind in kinds:
        for name, layer in OF_KIND[kind].items():
            known = layers.get(name)
            if known is not None and known != layer:
                both = dict.fromkeys((known.label, layer.label))
                layer = Layer(" / ".join(both), f"{known.hint} {layer.hint}", known.shown)
            layers[name] = layer
    return layers


def about(kind: str) -> str:
    """What one is looking at, as markdown."""
    return "\n\n".join(f"**{layer.label}.** {layer.hint}" for layer in OF_KIND[kind].values())


def _svg(inside: str) -> str:
    size = 'width="13" height="13" viewBox="0 0 12 12" style="vertical-align:-2px"'
    return f"<svg {size}>{inside}</svg>"


def _shape(goal: palette.Goal) -> str:
    look = f'fill="{css(goal.fill)}" stroke="{css(goal.rim)}"'
    return _svg(
        {
            "diamond": f'<path d="M6 1 11 6 6 11 1 6Z" {look}/>',
            "circle": f'<circle cx="6" cy="6" r="4.5" {look}/>',
            "square": f'<rect x="2" y="2" width="8" height="8" {look}/>',
        }[goal.shape]
    )


def _dot(colour: RGB) -> str:
    return _svg(f'<circle cx="6" cy="6" r="5" fill="{css(colour)}" stroke="#888888"/>')


def _ring() -> str:
    return _svg(
        f'<circle cx="6" cy="6" r="4.5" fill="none" stroke="{css(MARK)}" stroke-width="2"/>'
    )


def _line(colour: RGB = TRAIL) -> str:
    return _svg(f'<path d="M1 9 5 4 11 3" fill="none" stroke="{css(colour)}" stroke-width="2"/>')


def _arrow() -> str:
    look = f'fill="none" stroke="{css(MARK)}" stroke-width="1.5"'
    return _svg(f'<path d="M1 6H11M7.5 2.5 11 6 7.5 9.5" {look}/>')
