"""ALP-GMM (Portelas et al. 2019): another curriculum that the Goal GAN is compared with."""

import numpy as np
import torch

from goalgan_bt.envs.maze import BoolArray, FloatArray
from goalgan_bt.runs.errors import UsageError

STATE = ("goals", "success", "recent_goals", "recent_success", "points", "seed")


class AlpGmm:
    """Absolute learning progress with Gaussian mixtures (Portelas et al. 2019).

    The progress at a goal is the change of outcome since the nearest goal that was tried before.
    Every `WINDOW` episodes a mixture is fitted to their (goal, progress); goals are drawn from its
    Gaussians in proportion to their mean progress, one in five uniformly.

    Args:
        low, high: (goal_dim,) the goal box, metres.
        rng: draws goals.

    Raises:
        UsageError: without scikit-learn (extra `study`).
    """

    WINDOW = 250  # episodes
    COMPONENTS = range(2, 11)
    UNIFORM = 0.2

    def __init__(self, low: FloatArray, high: FloatArray, rng: np.random.Generator) -> None:
        try:
            from sklearn.mixture import GaussianMixture
            from sklearn.neighbors import KDTree
            from threadpoolctl import threadpool_limits  # scikit-learn needs it itself
        except ImportError:
            raise UsageError(
                'alp_gmm needs scikit-learn: pip install "goalgan_bt[study]"'
            ) from None
        self._mixture, self._tree, self._limits = GaussianMixture, KDTree, threadpool_limits
        self._low, self._high, self._rng = low, high, rng
        self._goals, self._success = np.empty((0, len(low))), np.empty(0)
        self._recent, self._outcomes = self._goals, self._success  # not yet in a mixture
        self._points, self._fit_seed = np.empty((0, len(low) + 1)), 0  # of the mixture
        self._fitted = None

    def add(self, goals: FloatArray, success: FloatArray | BoolArray) -> None:
        """Take in finished episodes, (n, goal_dim), (n,); fits when there are enough."""
        self._recent = np.concatenate([self._recent, goals])
        self._outcomes = np.concatenate([self._outcomes, success])
        if len(self._recent) < self.WINDOW:
            return
        if len(self._goals):
            nearest = self._tree(self._goals).query(self._recent, return_distance=False)[:, 0]
            progress = np.abs(self._outcomes - self._success[nearest])
            self._points = np.column_stack([self._recent, progress])[-self.WINDOW :]
            self._fit_seed = int(self._rng.integers(2**31))
            self._fit()
        self._goals = np.concatenate([self._goals, self._recent])
        self._success = np.concatenate([self._success, self._outcomes])
        self._recent, self._outcomes = self._recent[:0], self._outcomes[:0]

    def _fit(self) -> None:
        how = dict(reg_covar=1e-4, init_params="random_from_data", random_state=self._fit_seed)
        with self._limits(1):  # matrices of 250 rows: threads only wait for each other
            mixtures = [self._mixture(k, **how).fit(self._points) for k in self.COMPONENTS]
        self._fitted = min(mixtures, key=lambda mixture: mixture.aic(self._points))

    def state_dict(self) -> dict[str, torch.Tensor]:
        """All that was tried, and what the mixture is fitted anew from."""
        tried = self._goals, self._success, self._recent, self._outcomes
        columns = (*tried, self._points, np.array(self._fit_seed))
        return dict(zip(STATE, map(torch.from_numpy, columns), strict=True))

    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        """Take over what `state_dict` gave."""
        *tried, self._points, seed = (state[name].numpy().copy() for name in STATE)
        self._goals, self._success, self._recent, self._outcomes = tried
        self._fit_seed = int(seed)
        if len(self._points):
            self._fit()

    def sample(self, n: int) -> FloatArray:
        """Goals in the box, (n, goal_dim)."""
        goals = self._rng.uniform(self._low, self._high, (n, len(self._low)))
        if self._fitted is None:
            return goals
        progress = np.maximum(self._fitted.means_[:, -1], 1e-6)
        chosen = self._rng.choice(len(progress), n, p=progress / progress.sum())
        dim = len(self._low)
        for i in np.flatnonzero(self._rng.random(n) >= self.UNIFORM):
            k = chosen[i]
            covariance = self._fitted.covariances_[k][:dim, :dim]
            goals[i] = self._rng.multivariate_normal(self._fitted.means_[k, :dim], covariance)
        return np.clip(goals, self._low, self._high)
