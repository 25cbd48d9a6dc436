"""The curriculum: which goals to try next (Florensa et al. 2018)."""
