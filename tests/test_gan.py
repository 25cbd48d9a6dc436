import numpy as np
import pytest
import torch
from test_networks import by_torch

from goalgan_bt.curriculum.gan import GoalGAN
from goalgan_bt.curriculum.settings import GanConfig

LOW, HIGH = np.array([-3.0, -3.0]), np.array([7.0, 7.0])


def make_gan(**settings):
    torch.manual_seed(0)
    return GoalGAN(LOW, HIGH, GanConfig(**settings), torch.Generator().manual_seed(0))


@pytest.mark.parametrize("target", [1.0, 0.0])
def test_the_generator_moves_onto_positives_and_leaves_negatives(target):
    """Positives on a ring around the box's centre, negatives in the corners."""
    gan = make_gan(goal_noise=0.0, generator_target=target)
    rng = np.random.default_rng(0)
    angle = rng.uniform(0, 2 * np.pi, 200)
    ring = 2 + 2 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    corners = 2 + rng.choice([-4.5, 4.5], (200, 2)) + rng.normal(0, 0.2, (200, 2))
    goals, labels = np.concatenate([ring, corners]), np.arange(400) < 200
    gan.fit(goals, labels, steps=600)
    samples = gan.sample(500)
    radius = np.linalg.norm(samples - 2, axis=1)
    assert (radius < 3.5).mean() > 0.9


def test_samples_stay_in_the_box_with_the_noise_asked_for():
    gan = make_gan(goal_noise=20.0)
    samples = gan.sample(1000)
    assert samples.shape == (1000, 2)
    assert (samples >= LOW).all() and (samples <= HIGH).all()
    assert (samples == HIGH).any()  # clipped, not rejected
    torch.manual_seed(0)
    still, noisy = make_gan(goal_noise=0.0), make_gan(goal_noise=0.5)
    # The same z for both: the difference is the noise.
    assert np.std(noisy.sample(2000) - still.sample(2000)) == pytest.approx(0.5, rel=0.1)


def test_nothing_is_learned_from_labels_that_are_all_negative():
    gan = make_gan()
    before = [p.clone() for p in [*gan.generator.parameters(), *gan.discriminator.parameters()]]
    losses = gan.fit(np.zeros((50, 2)), np.zeros(50, dtype=bool))
    assert np.isnan(list(losses.values())).all()
    after = [*gan.generator.parameters(), *gan.discriminator.parameters()]
    assert all(torch.equal(a, b) for a, b in zip(before, after, strict=True))


def test_losses_by_hand():
    """One step on one goal with a fixed discriminator: (2y-1-D)^2, (D+1)^2 and (D-c)^2."""
    gan = make_gan(generator_target=0.0, batch=1)
    with torch.no_grad():
        gan.discriminator.flat.zero_()
        gan.discriminator.views()[-1].fill_(0.5)  # D = 0.5 everywhere
    for group in gan.discriminator_optimiser.param_groups:
        group["lr"] = 0.0
    losses = gan.fit(np.zeros((1, 2)), np.array([True]), steps=1)
    assert losses["discriminator_loss"] == pytest.approx((0.5**2 + 1.5**2) / 2)
    assert losses["generator_loss"] == pytest.approx(0.25)


def test_both_gradients_are_autograds():
    """One step whose optimisers stand still: what they were given, against torch."""
    gan = make_gan(batch=8)
    for optimiser in (gan.generator_optimiser, gan.discriminator_optimiser):
        optimiser.param_groups[0]["lr"] = 0.0
    state = gan._rng.get_state()
    rng = np.random.default_rng(0)
    goals, labels = rng.uniform(LOW, HIGH, (8, 2)), np.arange(8) < 3
    gan.fit(goals, labels, steps=1)
    twin = torch.Generator()
    twin.set_state(state)
    rows = torch.randint(8, (8,), generator=twin)
    z = torch.randn(8, gan.cfg.noise_dim, generator=twin)
    real = torch.from_numpy(2 * (goals - LOW) / (HIGH - LOW) - 1).float()[rows]
    target = torch.from_numpy(2.0 * labels - 1).float()[rows, None]
    fake = torch.tanh(by_torch(gan.generator, gan.generator.flat, z))

    def judge(x):
        return by_torch(gan.discriminator, gan.discriminator.flat, x)

    real_loss, fake_loss = (judge(real) - target) ** 2, (judge(fake.detach()) + 1) ** 2
    loss = torch.cat([real_loss, fake_loss]).mean()
    (of_discriminator,) = torch.autograd.grad(loss, gan.discriminator.flat)
    (of_generator,) = torch.autograd.grad(((judge(fake) - 1) ** 2).mean(), gan.generator.flat)
    assert torch.allclose(gan.discriminator.flat.grad, of_discriminator, atol=1e-6)
    assert torch.allclose(gan.generator.flat.grad, of_generator, atol=1e-6)
