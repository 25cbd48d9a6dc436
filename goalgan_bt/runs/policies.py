"""The policies that a run keeps of some of its measurements, so that one can look back.

policies/000040.pt   the policy as it was after iteration 40, and the places whose ways it goes by
"""

from pathlib import Path
from typing import Any

from goalgan_bt.runs.frames import NUMBER

FOLDER = "policies"
MOST = 24  # kept; when there are more, the one between the two that are closest goes


def policy_alone(state: dict[str, Any]) -> dict[str, Any]:
    """Of a checkpoint of the maze learner only what it takes to play its policy: a tenth of it."""
    learner = {name: state["learner"][name] for name in ("policy", "places")}
    return {"learner": learner, "run": {"iteration": state["run"]["iteration"]}}


def keep_policy(state: dict[str, Any], folder: Path) -> None:
    """Keep the policy of a run's checkpoint, of which `state` is what was saved."""
    from goalgan_bt.runs import checkpoint  # torch, which who only looks or removes does not need

    home = folder / FOLDER
    if home.is_symlink() or (home.exists() and not home.is_dir()):
        return  # somebody else's folder must not lead what is written away
    home.mkdir(exist_ok=True)
    checkpoint.save(policy_alone(state), home / f"{state['run']['iteration']:06d}.pt")
    kept = kept_policies(folder)
    if len(kept) > MOST:
        at = [int(path.stem) for path in kept]
        gaps = [after - before for before, after in zip(at, at[2:], strict=False)]
        kept[1 + gaps.index(min(gaps))].unlink()


def kept_policies(folder: Path) -> list[Path]:
    """Those of a run, oldest first; none where their folder is a link."""
    home = folder / FOLDER
    if home.is_symlink():
        return []
    return sorted(path for path in home.glob("*.pt") if NUMBER.fullmatch(path.stem))


def kept_policy(folder: Path, iteration: int | None) -> Path | None:
    """The last one of an iteration or before, or the first if all are later; None if there is none
    at all, or for no iteration."""
    kept = [] if iteration is None else kept_policies(folder)
    before = [path for path in kept if int(path.stem) <= (iteration or 0)]
    return before[-1] if before else kept[0] if kept else None


def forget_after(folder: Path, iteration: int) -> None:
    """Remove those of later iterations, which a run that goes on from this one makes again."""
    for path in kept_policies(folder):
        if int(path.stem) > iteration:
            path.unlink()
