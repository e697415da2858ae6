"""A generator in a module that a black box without noise imports when it is called."""

import numpy as np

GENERATOR = np.random.default_rng(0)
