"""Ask and tell: searches over the parameters of a black box whose evaluations the caller owns."""
