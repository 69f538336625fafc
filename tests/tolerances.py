"""Numerical tolerances of the tests, each with its reason; those for users are in
`morgs_mi.testing`.
"""

from morgs_mi.testing import (  # noqa: F401
    CENTRAL_DIFFERENCE_REL,
    DUALITY_REL,
    GRADIENT_REL,
    IMAGE_ABS,
    STOPPED_IMAGE_ABS,
    SUM_ORDER_REL,
)

# Per pixel that a splat moves, with a standard deviation of at least sqrt(0.3) px: alpha changes by
# at most 1.1, its slope by at most 3.3. A screen coordinate X is the result of three roundings,
# each of 2^-24 X.
ALPHA_PER_PIXEL = 3 * 1.1
ALPHA_SLOPE_PER_PIXEL = 3 * 3.3
# Sums over randomly weighted pixels may cancel. Of 2,000 seeds 90 % stay below 7e-6 and one exceeds
# this bound, 1090: the terms of a confidence add up to 23 in absolute value and to -0.006 with
# their signs, off by 1.4e-5. The next are tilts of needles thousands of px long with centres far
# from the pixels: u = a dx + b dy cancels.
FUZZ_GRADIENT_REL = 2e-3
# SSIM subtracts squares of float32 means; the loss averages that over the image.
LOSS_REL = 1e-4
# The derivative of a float32 SSIM map against float64 differences.
LOSS_GRADIENT_REL = 5e-3
