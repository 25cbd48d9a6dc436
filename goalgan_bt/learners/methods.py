"""What the default is compared with, as settings of the one training loop.

    python -m goalgan_bt.train --env point_umaze --method uniform

Each is a set of values for settings by name; what is not named is as in the default.
"""

from typing import Any

NO_TRACES = {"backtracking.trace_length": 0}
NO_REPLAY = NO_TRACES | {"goals.old": 0, "goals.label_rollouts": 0}  # nothing learns from labels

METHODS: dict[str, dict[str, Any]] = {
    "recall_traces": {},
    # Goyal et al. 2019 to the letter, as far as it is one: the model of section 2.1, trained for
    # 100 steps per 5 updates; traces from the goals, by sampled actions, for the goal at the end.
    "recall_traces_paper": {
        "backtracking.steps": 20,
        "backtracking.batch": 256,
        "backtracking.experience": "successes",
        "imitation.steps": 20,
        "imitation.max_kl": 0.02,
        "imitation.fade": None,
        "imitation.relabel": False,
    },
    # Curricula without traces.
    "goal_gan": NO_TRACES,
    "gan_fit_all": NO_TRACES | {"goals.source": "gan_fit_all"},
    "uniform": NO_REPLAY | {"goals.source": "uniform"},
    "feasible": NO_REPLAY | {"goals.source": "feasible"},
    "oracle": NO_REPLAY | {"goals.source": "oracle"},
    "alp_gmm": NO_REPLAY | {"goals.source": "alp_gmm"},
    # Controls: what of the default does it? Real steps of successes for their own goal, or of all
    # episodes for later places, take the place of traces, with as many updates. Without imitation
    # all is as in goal_gan but for the random numbers: so far apart are two methods that are one.
    "no_imitation": {"imitation.steps": 0},
    "random_model": {"backtracking.steps": 0},
    "self_imitation": {
        "backtracking.experience": "successes",
        "imitation.source": "experience",
        "imitation.relabel": False,
    },
    "hindsight": {
        "backtracking.experience": "all",
        "imitation.source": "experience",
        "imitation.relabel": True,
    },
    "value_seeds": {"backtracking.seeds": "values"},
    "forward_model": {"imitation.source": "forward"},
}
