"""A generator in a module that a black box imports when it is called."""

import numpy as np

GENERATOR = np.random.default_rng(0)
