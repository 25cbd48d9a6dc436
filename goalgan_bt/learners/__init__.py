"""The learners: mazes, four rooms, locomotion, and the callback for Stable-Baselines3."""
