"""Trained policies that come along: `python -m goalgan_bt.demo`.

`ant_umaze` and `point_umaze` are what `benchmarks/ship.py` keeps of two runs of the defaults, seed
0; each `meta.json` tells the command and the commit.
"""

from pathlib import Path

HOME = Path(__file__).parent
RUNS = ("ant_umaze", "point_umaze")
