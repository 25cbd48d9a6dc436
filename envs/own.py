"""Environments of one's own, beside those that are built in.

A program registers them (`goalgan_bt.register_env`), or they are named by where they are,
`module:factory`. Naming one imports its module, which is code: only the command line and
`GOALGAN_BT_ENVS` (names with commas between them) are asked for it, never a run folder.
"""

import importlib
import os
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from goalgan_bt.envs.goal_env import GoalEnv

VARIABLE = "GOALGAN_BT_ENVS"


class OwnEnvError(ValueError):
    """An environment of one's own that is none, or that nobody has allowed; says what to do."""


class Own(NamedTuple):
    """make: a body in a maze, as a class derived from `goalgan_bt.envs.mujoco_env.MazeEnv` (see
    `RobotMaze`), or a function of num_envs, horizon (or None), action_repeat and threads that gives
    a `GoalEnv`.
    preset: settings by name, as those of a method, and `like`: the environment whose preset is
    theirs otherwise."""

    make: "Callable[..., GoalEnv]"
    preset: Mapping[str, Any]


_registered: dict[str, Own] = {}


def register(
    name: str, make: "Callable[..., GoalEnv]", preset: Mapping[str, Any] | None = None
) -> None:
    """Let `name` be an environment, of this process.

    Args:
        name: a word of letters, digits and `_`.
        make: see `Own`.
        preset: see `Own`; by default that of `make`, if it has one.

    Raises:
        OwnEnvError: for a name that is no word or taken, by another class or function, too, and
            for what cannot be called.
    """
    from goalgan_bt.envs import NAMES

    word = isinstance(name, str) and name.isidentifier()
    before = _registered.get(name) if word else None
    if not word or name in NAMES or (before is not None and before.make is not make):
        raise OwnEnvError(f"{name!r} cannot be an environment's name: it is taken or no word")
    _registered[name] = _own(name, make, preset)


def allow(name: str) -> None:
    """Let the code of `module:factory` run, in this process and in those that it starts."""
    allowed = _allowed()
    if ":" in name and name not in allowed:
        os.environ[VARIABLE] = ",".join([*allowed, name])


def find(name: str) -> Own | None:
    """What is known by that name, or None if it is no environment of one's own.

    Raises:
        OwnEnvError: for a `module:factory` that is none, or that nobody has allowed.
    """
    if name not in _registered and ":" in name:
        if name not in _allowed():
            raise OwnEnvError(
                f"{name} is an environment of somebody's own: if you trust its code, let it run "
                f"with {VARIABLE}={name}"
            )
        _registered[name] = _own(name, _imported(name), None)
    return _registered.get(name)


def made(name: str, make: Callable[..., Any], *settings: Any) -> Any:
    """What the code of an environment of one's own makes.

    Raises:
        OwnEnvError: if it fails, or makes something else.
    """
    from goalgan_bt.envs.goal_env import GoalEnv, PhysicsError

    try:
        env = make(*settings)
    except PhysicsError:
        raise
    except Exception as error:  # of code that is not ours
        raise OwnEnvError(f"{name} failed with {type(error).__name__}: {error}") from error
    if not isinstance(env, GoalEnv):
        raise OwnEnvError(f"{name} made {type(env).__name__}, and no GoalEnv")
    return env


def _allowed() -> list[str]:
    return [name.strip() for name in os.environ.get(VARIABLE, "").split(",") if name.strip()]


def _own(name: str, make: Any, preset: Mapping[str, Any] | None) -> Own:
    if not callable(make):
        raise OwnEnvError(f"{name}: {make!r} is neither a class nor a function")
    settings = getattr(make, "preset", {}) if preset is None else preset
    if not isinstance(settings, Mapping):
        raise OwnEnvError(f"{name}: its preset must be a dictionary, not {settings!r}")
    return Own(make, settings)


def _imported(name: str) -> Any:
    module, _, factory = name.partition(":")
    try:
        there = importlib.import_module(module)
    except (Exception, SystemExit) as error:  # of code that is not ours
        kind = type(error).__name__
        raise OwnEnvError(f"{name}: importing {module!r} failed with {kind}: {error}") from error
    try:
        return getattr(there, factory)
    except AttributeError:
        raise OwnEnvError(f"{name}: there is no {factory!r} in {module}") from None
