"""The curriculum: which goals to try next, told only how trying went (Florensa et al. 2018).

    curriculum = GoalCurriculum(low, high, seed=0)
    while training:
        goals = curriculum.ask(n)
        ...                                            # try them
        curriculum.tell(goals, success, visited=places)

`ask` and `tell` are made of the parts below them, which a loop may also call itself, as the maze
learner does: it collects episodes as they end and lets the GAN learn in the background.
"""

import ast
import math
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike

from goalgan_bt.agent.networks import first_weights
from goalgan_bt.curriculum.alp_gmm import AlpGmm
from goalgan_bt.curriculum.gan import GoalGAN
from goalgan_bt.curriculum.goals import FAR, GoalMemory, SuccessEstimator, goals_of, intermediate
from goalgan_bt.curriculum.settings import GanConfig, GoalsConfig, conflicts
from goalgan_bt.envs.maze import BoolArray, FloatArray
from goalgan_bt.runs import checkpoint
from goalgan_bt.runs.errors import UsageError
from goalgan_bt.runs.ranges import require, require_box, require_whole

SIDE = 10.0  # metres, of the papers' goal box, for which the default distances are made
WORLDLY = ("feasible", "oracle")  # sources of goals that a curriculum alone does not have
MANY = 3  # dimensions, beyond which places visited are too many to remember


class Judged(NamedTuple):
    """labels: (n,) which of some goals are of intermediate difficulty; lesson: goals (m, goal_dim)
    and labels (m,) from which the GAN shall learn."""

    labels: BoolArray
    lesson: tuple[FloatArray, BoolArray]


class GoalCurriculum:
    """Proposes goals of intermediate difficulty: neither mastered nor hopeless.

    Args:
        low, high: (goal_dim,) the box of the goals, in any units.
        seed: of everything random.
        goals, gan: settings, whose distances are in the units of the box. Without them those of the
            papers, for which each side of the box counts as 10 m.
        every: goals told between two lessons of the GAN.
        rng, noise: the generators of a learner that has its own and has seeded torch itself, from
            which first weights then come; the seed counts for nothing.

    Attributes:
        gan: the Goal GAN; replay: goals that once were intermediate; visited: places where the
            agent has been; estimator: of success.

    Raises:
        ValueError: for a box that is none, or settings out of their range.
    """

    def __init__(
        self,
        low: ArrayLike,
        high: ArrayLike,
        seed: int = 0,
        goals: GoalsConfig | None = None,
        gan: GanConfig | None = None,
        *,
        every: int = 100,
        rng: np.random.Generator | None = None,
        noise: torch.Generator | None = None,
    ) -> None:
        self.low, self.high = require_box(low, high)
        dim = len(self.low)
        self._unit, self._centre = np.ones(dim), np.zeros(dim)
        if goals is None:  # inside, the box is a cube of 10 m around zero
            self._unit, self._centre = (self.high - self.low) / SIDE, (self.low + self.high) / 2
            near = 1.0 if dim <= MANY else math.inf
            goals = GoalsConfig(anywhere=0.1, near=near)
        self.cfg, self._gan_cfg, self._every = goals, gan or GanConfig(), every
        _check(seed, every, self.cfg, self._gan_cfg)
        self._box = self._inward(self.low), self._inward(self.high)
        self.rng = rng or np.random.default_rng(seed)
        self._noise = noise or torch.Generator().manual_seed(seed)
        with first_weights(seed if noise is None else None):
            self.gan = GoalGAN(*self._box, self._gan_cfg, self._noise)
        self.alp_gmm = AlpGmm(*self._box, self.rng) if goals.source == "alp_gmm" else None
        self.estimator = SuccessEstimator(dim, goals)
        self.replay = GoalMemory(dim, goals.replay_distance)
        self.visited = GoalMemory(dim, goals.near / 2)
        self._asked, self._begun = False, False
        self._pending: list[FloatArray] = []  # goals told since the GAN's last lesson

    # For a loop of one's own.

    def ask(self, n: int) -> FloatArray:
        """Goals to try next, (n, goal_dim): most imagined by the GAN, some remembered so that old
        skills stay. Until the GAN has heard of a place that can be reached they are uniform.

        Raises:
            UsageError: for a number that is none, or a source of goals that must know the world.
        """
        if isinstance(n, bool) or not isinstance(n, int | np.integer) or n < 0:
            raise UsageError(f"ask for a whole number of goals, 0 or more, not {n!r}")
        if self.cfg.source in WORLDLY:
            raise UsageError(f"{self.cfg.source!r} goals need to know the world: ask for 'gan'")
        self._asked = True
        if not self._begun:
            return self._outward(self.uniform(n))
        share = self.cfg.old / max(1, self.cfg.new + self.cfg.old)
        remembered = self.recollect(self.rng.binomial(n, share))
        return self._outward(np.concatenate([self.propose(n - len(remembered)), remembered]))

    def tell(
        self, goals: ArrayLike, success: ArrayLike, visited: ArrayLike | None = None
    ) -> dict[str, float]:
        """How trying goals went; every now and then the GAN learns from it.

        Args:
            goals: (n, goal_dim) that were tried from where episodes begin, those of `ask` or
                others, in any order and of any number.
            success: (n,) whether each was reached, or how often, 0 to 1.
            visited: (m, goal_dim) places that can be reached because the agent has been there, such
                as where episodes ended. The more of them are known, the better the GAN knows where
                not to look; without any, goals that were reached count as such.

        Returns:
            Where the GAN has learned: intermediate, the share of such goals; gan_... its losses.

        Raises:
            UsageError: before the first `ask`, for arrays that do not fit, or numbers that cannot
                be; nothing is taken in then.
        """
        if not self._asked:
            raise UsageError("nothing was asked for yet: call ask() first, and tell how it went")
        tried, places = self._rows(goals, "goals"), self._rows(visited, "visited")
        outcome = _numbers(success, "success")
        if outcome.shape != (len(tried),):
            raise UsageError(
                f"success must have one number for each of the {len(tried)} goals, "
                f"not the shape {outcome.shape}"
            )
        if not ((outcome >= 0) & (outcome <= 1)).all():
            raise UsageError("success is whether a goal was reached, or how often: 0 to 1")
        places = places if visited is not None else tried[outcome > 0]
        self.remember(tried, outcome)
        self.see(places)
        self._pending.append(tried)
        if not self._begun and len(places):
            self.begin(places)
        if not self._begun or sum(map(len, self._pending)) < self._every:
            return {}
        pending = np.concatenate(self._pending)
        self._pending.clear()
        judged = self.judge(pending, self.estimator(pending))
        losses = self.gan.fit(*judged.lesson)
        told = {f"gan_{name}": float(value) for name, value in losses.items()}
        return told | {"intermediate": float(judged.labels.mean())}

    def success(self, goals: ArrayLike) -> FloatArray:
        """Estimated success at goals (n, goal_dim), (n,) in [0, 1]; NaN while too little is known.

        Raises:
            UsageError: for goals that do not fit.
        """
        return self.estimator(self._rows(goals, "goals"))

    def save(self, path: Path | str) -> None:
        """Write all of it to a file, to go on from there (`load`).

        Raises:
            OSError: if that fails; an old file is left as it was.
        """
        given = None if (self._unit != 1).any() or self._centre.any() else asdict(self.cfg)
        made = {
            "low": self.low.tolist(),
            "high": self.high.tolist(),
            "goals": given,
            "gan": asdict(self._gan_cfg),
            "every": self._every,
        }
        state = {
            "made": made,
            "rng": repr(self.rng.bit_generator.state),
            "noise": self._noise.get_state(),
            "flags": [self._asked, self._begun],
            "pending": [torch.from_numpy(goals) for goals in self._pending],
            **self.state_dict(),
        }
        checkpoint.save(state, Path(path))

    @classmethod
    def load(cls, path: Path | str) -> "GoalCurriculum":
        """What `save` wrote.

        Raises:
            OSError: if the file cannot be opened.
            ValueError: if it is damaged or of another version.
        """
        with checkpoint.loaded(Path(path)) as state:
            made = state["made"]
            goals = None if made["goals"] is None else GoalsConfig(**made["goals"])
            gan = GanConfig(**made["gan"])
            curriculum = cls(made["low"], made["high"], 0, goals, gan, every=int(made["every"]))
            curriculum.load_state_dict(state)
            curriculum.rng.bit_generator.state = ast.literal_eval(state["rng"])
            curriculum._noise.set_state(state["noise"])
            curriculum._asked, curriculum._begun = map(bool, state["flags"])
            curriculum._pending = [goals.numpy() for goals in state["pending"]]
            curriculum._check_loaded()
        return curriculum

    def _check_loaded(self) -> None:
        """Refuse what no curriculum of this box can hold.

        Raises:
            ValueError: saying what it is.
        """
        memories = self.replay.goals, self.visited.goals, self.estimator.goals, *self._pending
        for goals in memories:
            if goals.shape[1:] != self.low.shape or not np.isfinite(goals).all():
                raise ValueError("goals that it remembers are none of its box")
        for network in (self.gan.generator, self.gan.discriminator):
            if not network.flat.isfinite().all():
                raise ValueError("a weight is not finite")

    # What those are made of. Here goals are in the units of the settings.

    def uniform(self, n: int) -> FloatArray:
        """Goals anywhere in the box, (n, goal_dim)."""
        return self.rng.uniform(*self._box, (n, len(self.low)))

    def begin(self, places: FloatArray) -> None:
        """Let the GAN begin with wherever the agent happens to be, (m, goal_dim)."""
        self.gan.fit(places, np.ones(len(places), dtype=bool), self._gan_cfg.pretrain_steps)
        self._begun = True

    def propose(self, n: int) -> FloatArray:
        """New goals, (n, goal_dim): the GAN's (or ALP-GMM's), and where the settings want it some
        from anywhere, lest a GAN that has closed in on mastered goals hears of no others.

        Those of a source that must know the world are `goalgan_bt.curriculum.baselines`'.
        """
        if self.alp_gmm is not None:
            return self.alp_gmm.sample(n)
        if self.cfg.source == "uniform":
            return self.uniform(n)
        goals = self.gan.sample(n * self.cfg.imagined)
        if self.cfg.imagined > 1:
            good = self._intermediate(goals, self.estimator(goals))
            goals = goals[np.argsort(~good, kind="stable")[:n]]
            self.rng.shuffle(goals)
        whole, rest = divmod(self.cfg.anywhere * n, 1)
        # Of few goals at a time each may be that one.
        if k := int(whole) + (rest > 0 and self.rng.random() < rest):
            goals[:k] = self.uniform(k)
        return goals

    def recollect(self, n: int) -> FloatArray:
        """At most n goals that once were intermediate, (<= n, goal_dim), so that old skills stay;
        with a frontier none that has turned out to be hopeless."""
        goals = self.replay.sample(len(self.replay), self.rng)
        return goals[~self.estimator.hopeless(goals)][:n] if self.cfg.frontier else goals[:n]

    def remember(self, goals: FloatArray, success: FloatArray | BoolArray) -> None:
        """Take in finished episodes from the start: goals (n, goal_dim), success (n,)."""
        self.estimator.add(goals, success)
        if self.alp_gmm is not None:
            self.alp_gmm.add(goals, success)

    def see(self, places: FloatArray) -> None:
        """Take in places where the agent has been, (m, goal_dim); a diverged body is nowhere."""
        self.visited.add(places[(np.abs(places) < FAR).all(axis=1)])

    def judge(self, goals: FloatArray, success: FloatArray) -> Judged:
        """Label goals that were tried, and keep the intermediate ones for replay.

        Args:
            goals: (n, goal_dim).
            success: (n,) how often each is reached.

        Returns:
            Their labels, and a lesson for the GAN: these goals and their labels, followed by goals
            that nobody tried, since the estimator's labels are free.
        """
        labels = self._intermediate(goals, success)
        self.replay.add(goals[labels])
        if self.cfg.source == "gan_fit_all":
            everywhere = self.visited.goals
            return Judged(labels, (everywhere, np.ones(len(everywhere), dtype=bool)))
        others = self.uniform(0 if self.cfg.label_rollouts else self.cfg.labelled)
        other_labels = self._intermediate(others, self.estimator(others))
        lesson = np.concatenate([goals, others]), np.concatenate([labels, other_labels])
        return Judged(labels, lesson)

    def mapped(self, goals: FloatArray, reach: float) -> FloatArray:
        """What a map shows: estimated success at goals (n, goal_dim), (n,), but 0 where the agent
        has never been within `reach` of them."""
        return np.where(self.visited.distance_to(goals) <= reach, self.estimator(goals), 0.0)

    def state_dict(self) -> dict[str, Any]:
        """All that it has learned and remembers, its generators apart."""
        return {
            "gan": self.gan.state_dict(),
            "replay": torch.from_numpy(self.replay.goals),
            "visited": torch.from_numpy(self.visited.goals),
            "estimator": self.estimator.state_dict(),
            "alp_gmm": {} if self.alp_gmm is None else self.alp_gmm.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take over what `state_dict` gave."""
        self.gan.load_state_dict(state["gan"])
        self.replay.goals = goals_of(state["replay"], len(self.low))
        self.visited.goals = goals_of(state["visited"], len(self.low))
        self.estimator.load_state_dict(state["estimator"])
        if self.alp_gmm is not None:
            self.alp_gmm.load_state_dict(state["alp_gmm"])

    def _intermediate(self, goals: FloatArray, success: FloatArray) -> BoolArray:
        """Labels of goals (n, goal_dim) with that success (n,): intermediate difficulty, (n,).

        Besides the bounds on success, a goal must be near a place where the agent has been: the
        estimator averages over neighbours, and beside a mastered place there may be a wall. With a
        frontier it must be near enough to one to be tried, and not hopeless: what lies beyond all
        that the agent has seen is learned by trying, and so are the walls.
        """
        away = self.visited.distance_to(goals)
        if self.cfg.frontier:
            worth = (away <= self.cfg.frontier) & ~self.estimator.hopeless(goals)
            return worth & ~(success >= self.cfg.r_max)
        return intermediate(success, self.cfg.r_min, self.cfg.r_max) & (away <= self.cfg.near)

    def _rows(self, goals: ArrayLike | None, name: str) -> FloatArray:
        """Goals as rows in the units of the settings; none if there are none.

        Raises:
            UsageError: naming what is wrong with them.
        """
        dim = len(self.low)
        rows = np.empty((0, dim)) if goals is None else _numbers(goals, name)
        if rows.ndim != 2 or rows.shape[1] != dim:
            raise UsageError(f"{name} must be rows of {dim} numbers, not the shape {rows.shape}")
        skin = 1e-6 * (self.high - self.low)  # single precision
        outside = ~((rows >= self.low - skin) & (rows <= self.high + skin)).all(axis=1)
        if outside.any() and name == "goals":
            first = int(outside.argmax())
            raise UsageError(
                f"goal {first} is {rows[first].tolist()}, outside of the box from "
                f"{self.low.tolist()} to {self.high.tolist()}"
            )
        return self._inward(rows[~outside])  # a place out of the box is no goal

    def _inward(self, goals: FloatArray) -> FloatArray:
        return (goals - self._centre) / self._unit

    def _outward(self, goals: FloatArray) -> FloatArray:
        return np.clip(self._centre + self._unit * goals, self.low, self.high)


def _numbers(given: ArrayLike, name: str) -> FloatArray:
    """An array of numbers.

    Raises:
        UsageError: if it is none.
    """
    try:
        return np.asarray(given, dtype=float)
    except (TypeError, ValueError):
        raise UsageError(f"{name} must be an array of numbers") from None


def _check(seed: int, every: int, goals: GoalsConfig, gan: GanConfig) -> None:
    """Refuse what makes no sense.

    Raises:
        UsageError: naming it.
    """
    require_whole("seed", seed, 0)
    require_whole("every", every, 1)
    for settings, kind in ((goals, GoalsConfig), (gan, GanConfig)):
        if not isinstance(settings, kind):
            raise UsageError(f"settings must be a {kind.__name__}, not {settings!r}")
        require(settings)
    for name, problem in conflicts(goals):
        raise UsageError(f"{name} {problem}")
