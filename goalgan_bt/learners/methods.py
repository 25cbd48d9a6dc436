"""What the default is compared with, as settings of the one training loop.

    python -m goalgan_bt.train --env point_umaze --method goal_gan

Each is a set of values for settings by name; what is not named is as in the default.
"""

from typing import Any

# Goal GAN, as it was best without places: goals of intermediate difficulty, sparse rewards alone.
ALONE = {
    "places.shaping": 0.0,
    "places.heading": False,
    "goals.frontier": 0.0,
    "goals.imagined": 1,
    "gae_lambda": 0.95,
    "imitation.source": "none",
}
TRACES = ALONE | {"imitation.source": "traces"}  # recall traces of full states, nothing over places
NO_REPLAY = {"goals.old": 0, "goals.label_rollouts": 0}  # nothing learns from labels

METHODS: dict[str, dict[str, Any]] = {
    "recall_traces": {},
    # Goyal et al. 2019 to the letter, as far as it is one: the model of section 2.1, trained for
    # 100 steps per 5 updates; traces from the goals, by sampled actions, for the goal at the end.
    "recall_traces_paper": TRACES
    | {
        "backtracking.steps": 20,
        "backtracking.batch": 256,
        "backtracking.experience": "successes",
        "imitation.steps": 20,
        "imitation.max_kl": 0.02,
        "imitation.fade": None,
        "imitation.relabel": False,
    },
    # Curricula without recall, and one that knows the walls with it.
    "goal_gan": ALONE,
    "gan_fit_all": ALONE | {"goals.source": "gan_fit_all"},
    "uniform": ALONE | NO_REPLAY | {"goals.source": "uniform"},
    "feasible": ALONE | NO_REPLAY | {"goals.source": "feasible"},
    "feasible_places": NO_REPLAY | {"goals.source": "feasible"},
    "oracle": ALONE | NO_REPLAY | {"goals.source": "oracle"},
    "alp_gmm": ALONE | NO_REPLAY | {"goals.source": "alp_gmm"},
    # Controls of the default: which of its parts does it, and is it the places?
    "shaping_only": {"places.heading": False},
    "heading_only": {"places.shaping": 0.0},
    "straight_line": {"places.way": "straight", "places.heading": False},
    "goals_only": {"places.shaping": 0.0, "places.heading": False},
    "with_traces": {"imitation.source": "traces"},
    "with_hindsight": {"imitation.source": "experience"},
    # Traces of full states alone, tuned as we can, and their controls. Real steps of successes for
    # their own goal, or of all episodes for later places, take the place of traces, with as many
    # updates. Without imitation all is as in goal_gan but for the random numbers: so far apart are
    # two methods that are one.
    "traces_only": TRACES,
    "no_imitation": TRACES | {"imitation.steps": 0},
    "random_model": TRACES | {"backtracking.steps": 0},
    "self_imitation": ALONE
    | {
        "backtracking.experience": "successes",
        "imitation.source": "experience",
        "imitation.relabel": False,
    },
    "hindsight": ALONE
    | {
        "backtracking.experience": "all",
        "imitation.source": "experience",
        "imitation.relabel": True,
    },
    "value_seeds": TRACES | {"backtracking.seeds": "values"},
    "forward_model": ALONE | {"imitation.source": "forward"},
}
