"""The agent: a goal-conditioned Gaussian policy trained by TRPO."""
