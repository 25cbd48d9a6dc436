"""The front door: `goalgan-bt COMMAND` and `python -m goalgan_bt COMMAND`.

Each command is a module of its own, which `python -m goalgan_bt.COMMAND` runs just the same.
"""

import runpy
import sys
from difflib import get_close_matches

COMMANDS = {
    "train": "learn a task; a page shows how it goes",
    "demo": "the page over an Ant that is trained already",
    "viz": "the page over runs, live or finished; or a run as an HTML file or a film of its map",
    "plot": "curves and coverage maps of runs as PNG, SVG or PDF",
    "study": "compare methods over seeds",
    "evaluate": "how well a trained policy does, in a maze of its own or of Gymnasium's",
    "record": "a film of a trained policy",
    "export": "a trained policy as an ONNX file, or its episodes as a data set of Minari's",
    "share": "a trained policy as a folder with a model card, on the Hugging Face hub or elsewhere",
}


def main() -> int:
    """The command line; returns the exit code."""
    words = sys.argv[1:]
    if not words or words[0] in ("-h", "--help", "--help-all", "help"):
        print("usage: goalgan-bt COMMAND ...\n")
        print("\n".join(f"  {name:<9} {what}" for name, what in COMMANDS.items()))
        print("\ngoalgan-bt COMMAND --help explains one; goalgan-bt train begins with the Ant.")
        return 0
    if words[0] not in COMMANDS:
        near = get_close_matches(words[0], COMMANDS, 1)
        meant = f"did you mean {near[0]}? Otherwise " if near else ""
        known = ", ".join(COMMANDS)
        print(f"error: no command {words[0]!r}: {meant}choose one of {known}", file=sys.stderr)
        return 2
    sys.argv = [f"goalgan-bt {words[0]}", *words[1:]]
    runpy.run_module(f"goalgan_bt.{words[0]}", run_name="__main__", alter_sys=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
