"""The inverse CDF of the normal density in single precision: the literal reference of `csrc/single.h`.

With p = (word + 1/2) / 2^32 for a word of 32 bits, mirrored to p < 1/2, the quantile is (1/2 - p) times a ratio. In
each octave p = 2^e t, 1 <= t < 2, the ratio is a polynomial in t. Below p = 2^-17 it is the rounded quantile of double
precision. The result is within 4 units in the last place of the exact quantile. Additions and multiplications of
float32 alone: the same bits on every machine and device.
"""

import torch
from torch import Tensor

from torch_zerohess.sampling.quantiles import normal_quantile

_TAIL = 1 << 15
_BELOW_HALF = 2.0**31 - 2.0**7
# Minimax polynomials / 2^32: by powers of t - 1.5 from the highest down, then by the last four bits of the exponent.
_RATIO = (
    (
        -1.0336775e-12,
        -1.0655313e-12,
        -1.1003568e-12,
        -1.138612e-12,
        -1.180843e-12,
        -1.2276943e-12,
        -1.2799057e-12,
        -1.3382724e-12,
        -1.4035168e-12,
        -1.4759611e-12,
        -1.5548014e-12,
        -1.6367281e-12,
        -1.7139254e-12,
        -1.7307925e-12,
        -9.774152e-13,
        -1.0044125e-12,
    ),
    (
        1.7356347e-12,
        1.790429e-12,
        1.8504855e-12,
        1.9166402e-12,
        1.9898933e-12,
        2.0714212e-12,
        2.162561e-12,
        2.2647034e-12,
        2.3789844e-12,
        2.5055264e-12,
        2.6418054e-12,
        2.7796053e-12,
        2.9008898e-12,
        3.0957368e-12,
        1.6391616e-12,
        1.6854059e-12,
    ),
    (
        -2.609691e-12,
        -2.6941383e-12,
        -2.7868922e-12,
        -2.8892945e-12,
        -3.0029423e-12,
        -3.1296962e-12,
        -3.2716134e-12,
        -3.4306945e-12,
        -3.6082036e-12,
        -3.8030998e-12,
        -4.0088406e-12,
        -4.207852e-12,
        -4.361967e-12,
        -4.0775664e-12,
        -2.4614293e-12,
        -2.5324317e-12,
    ),
    (
        4.990207e-12,
        5.155071e-12,
        5.336452e-12,
        5.5370365e-12,
        5.759995e-12,
        6.0089516e-12,
        6.2877464e-12,
        6.5997004e-12,
        6.945801e-12,
        7.3207725e-12,
        7.70571e-12,
        8.057599e-12,
        8.317269e-12,
        9.366958e-12,
        4.701422e-12,
        4.839615e-12,
    ),
    (
        -1.0233195e-11,
        -1.0581769e-11,
        -1.09662375e-11,
        -1.1392474e-11,
        -1.1867286e-11,
        -1.2398149e-11,
        -1.2992225e-11,
        -1.3653838e-11,
        -1.43788054e-11,
        -1.5143286e-11,
        -1.5884722e-11,
        -1.647064e-11,
        -1.6569164e-11,
        -1.3059587e-11,
        -9.624754e-12,
        -9.9155675e-12,
    ),
    (
        2.359844e-11,
        2.4443114e-11,
        2.5378312e-11,
        2.641849e-11,
        2.7579331e-11,
        2.887559e-11,
        3.0315823e-11,
        3.1891354e-11,
        3.3556328e-11,
        3.5199087e-11,
        3.662262e-11,
        3.7621514e-11,
        3.8633454e-11,
        4.6991317e-11,
        2.2132365e-11,
        2.2831733e-11,
    ),
    (
        -7.4849786e-11,
        -7.781025e-11,
        -8.1080496e-11,
        -8.4680006e-11,
        -8.860243e-11,
        -9.278845e-11,
        -9.708155e-11,
        -1.0116221e-10,
        -1.04460635e-10,
        -1.0605462e-10,
        -1.0454799e-10,
        -9.7797784e-11,
        -8.162167e-11,
        -4.1000866e-11,
        -6.973652e-11,
        -7.216926e-11,
    ),
    (
        1.8218118e-9,
        1.7424755e-9,
        1.6599023e-9,
        1.5737588e-9,
        1.4837025e-9,
        1.3894226e-9,
        1.2907152e-9,
        1.1876177e-9,
        1.0806211e-9,
        9.709831e-10,
        8.6115337e-10,
        7.553805e-10,
        6.6097566e-10,
        5.93512e-10,
        1.9719697e-9,
        1.8982185e-9,
    ),
)


def normal_quantile_of_words(words: Tensor) -> Tensor:
    """Return the quantiles of p = (word + 1/2) / 2^32, float32, for words as int64 of any shape."""
    upper = words >> 31 == 1
    beyond = torch.where(upper, 0xFFFFFFFF - words, words)
    bits = (beyond.float() + 0.5).clamp_max(_BELOW_HALF).view(torch.int32)
    octave = (bits >> 23 & 15).long()
    t = ((bits & 0x007FFFFF) | 0x3F800000).view(torch.float32) - 1.5
    table = torch.tensor(_RATIO, dtype=torch.float32, device=words.device)
    ratio = table[0][octave]
    for coefficients in table[1:]:
        ratio = ratio * t + coefficients[octave]
    u = ((0x7FFFFFFF - beyond).float() + 0.5) * ratio
    result = torch.where(upper, u, -u)
    tail = beyond < _TAIL
    result[tail] = normal_quantile((words[tail].double() + 0.5) * 2.0**-32).float()
    return result
