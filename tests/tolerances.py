"""Numerical tolerances of the tests, each with its reason."""

# The traced renderer works in float32 with a 2^p of relative error 3e-6 and sums some tens of
# layers.
IMAGE_ABS = 2e-5
# A stop at transmittance 1e-4 hides at most that much of a colour of 1, per channel; colours reach
# 1.5.
STOPPED_IMAGE_ABS = 2e-4
# Gradients add the rounding of sums over some hundred pixels; relative to the largest entry of an
# attribute.
GRADIENT_REL = 2e-4
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
# Forward and reverse mode take different roundings of the same sums.
DUALITY_REL = 2e-4
# Central differences of a float32 image at the best step are good to the cube root of its rounding.
CENTRAL_DIFFERENCE_REL = 2e-2
# SSIM subtracts squares of float32 means; the loss averages that over the image.
LOSS_REL = 1e-4
# The derivative of a float32 SSIM map against float64 differences.
LOSS_GRADIENT_REL = 5e-3
# The same float32 terms summed in another order, relative to the largest entry of an attribute.
SUM_ORDER_REL = 1e-5
