"""The Goal GAN: a least-squares GAN that proposes goals of intermediate difficulty.

Florensa et al. 2018, section 4.2: with a label y_g in {0, 1} for each goal (1: of intermediate
difficulty),
    D: min E_data[y (D(g) - b)^2 + (1 - y) (D(g) - a)^2] + E_z[(D(G(z)) - a)^2]
    G: min E_z[(D(G(z)) - c)^2]
with a = -1, b = 1 and c = 0 in the paper, c = b = 1 in the authors' code. Goals are normalised to
[-1, 1] over the goal box (the original's extra factor of 2 let samples land outside of it).
"""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from goalgan_bt.agent.networks import LEAKY_RELU, MLP, RELU, Linearised
from goalgan_bt.curriculum.settings import GanConfig
from goalgan_bt.envs.maze import BoolArray, FloatArray
from goalgan_bt.runs import checkpoint


class GoalGAN:
    """Generator and discriminator of goals in a box.

    Args:
        low, high: (goal_dim,) the goal box, metres.
        cfg: settings.
        generator: the source of z and of minibatches.
    """

    def __init__(
        self, low: FloatArray, high: FloatArray, cfg: GanConfig, generator: torch.Generator
    ) -> None:
        self.low, self.high, self.cfg, self._rng = low, high, cfg, generator
        dim = len(low)
        self.generator = MLP((cfg.noise_dim, *cfg.generator_hidden, dim), RELU)
        self.discriminator = MLP((dim, *cfg.discriminator_hidden, 1), LEAKY_RELU)
        # RMSProp with the original's decay. Adam without momentum is RMSProp with its start
        # corrected, and torch has it in one fused call: half the GAN's time went there.
        self.generator_optimiser, self.discriminator_optimiser = (
            torch.optim.Adam(net.parameters(), lr=cfg.learning_rate, betas=(0.0, 0.9), fused=True)
            for net in (self.generator, self.discriminator)
        )

    @torch.no_grad()
    def sample(self, n: int) -> FloatArray:
        """Goals from the generator plus noise, clipped to the box, (n, goal_dim) metres."""
        x = torch.tanh(self.generator(self._noise(n))).double()
        goals = (self.low + self.high) / 2 + (self.high - self.low) / 2 * x.numpy()
        noise = torch.randn(goals.shape, generator=self._rng, dtype=torch.float64).numpy()
        return np.clip(goals + self.cfg.goal_noise * noise, self.low, self.high)

    def fit(
        self, goals: FloatArray, labels: BoolArray, steps: int | None = None
    ) -> dict[str, float]:
        """Train both networks; not at all on labels that are all negative (nothing to imitate).

        Args:
            goals: (n, goal_dim) metres.
            labels: (n,) whether each is of intermediate difficulty.
            steps: training steps, `cfg.steps` if None.

        Returns:
            Mean losses of the last quarter: discriminator_loss, generator_loss (NaN if skipped);
            spread, how far the generator's goals are apart without the noise: their standard
            deviation, in half sides of the box; near 0 where it has collapsed.
        """
        if not labels.any():
            return dict.fromkeys(("discriminator_loss", "generator_loss", "spread"), np.nan)
        steps = self.cfg.steps if steps is None else steps
        x = torch.from_numpy(self._normalise(goals)).float()
        target = torch.from_numpy(2.0 * labels - 1.0).float()[:, None]
        losses = np.zeros((steps, 2))
        for i in range(steps):
            rows = torch.randint(len(x), (min(self.cfg.batch, len(x)),), generator=self._rng)
            generated = Linearised(self.generator, self._noise(self.cfg.batch))
            fake = torch.tanh(generated.output)

            judged = Linearised(self.discriminator, torch.cat([x[rows], fake]))
            error = judged.output - torch.cat([target[rows], -torch.ones(len(fake), 1)])
            self.discriminator.flat.grad = judged.vjp(error * (2 / len(error)))
            self.discriminator_optimiser.step()

            judged = Linearised(self.discriminator, fake)
            miss = judged.output - self.cfg.generator_target
            towards = judged.input_vjp(miss * (2 / len(miss)))
            self.generator.flat.grad = generated.vjp(towards * (1 - fake * fake))
            self.generator_optimiser.step()
            losses[i] = error.square().mean().item(), miss.square().mean().item()
        discriminator, generator = losses[-max(1, steps // 4) :].mean(axis=0)
        spread = fake.std(dim=0).mean().item()
        return {
            "discriminator_loss": discriminator,
            "generator_loss": generator,
            "spread": spread,
        }

    def _parts(self) -> dict[str, Any]:
        return {
            "generator": self.generator,
            "generator_optimiser": self.generator_optimiser,
            "discriminator": self.discriminator,
            "discriminator_optimiser": self.discriminator_optimiser,
        }

    def parameters(self) -> list[Tensor]:
        """Those of both networks."""
        return [self.generator.flat.detach(), self.discriminator.flat.detach()]

    def state_dict(self) -> dict[str, Any]:
        """Both networks and their optimisers."""
        return {name: part.state_dict() for name, part in self._parts().items()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take over what `state_dict` gave."""
        for name, part in self._parts().items():
            checkpoint.restore(part, state[name])

    def _normalise(self, goals: FloatArray) -> FloatArray:
        return 2 * (goals - self.low) / (self.high - self.low) - 1

    def _noise(self, n: int) -> Tensor:
        return torch.randn(n, self.cfg.noise_dim, generator=self._rng)
