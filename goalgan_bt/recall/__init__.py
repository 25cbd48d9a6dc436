"""Recall: how one may have come to a goal (Goyal et al. 2019)."""
