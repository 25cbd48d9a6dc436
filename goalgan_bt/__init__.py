"""Goal GAN with a backtracking model: `python -m goalgan_bt.train --help`."""
