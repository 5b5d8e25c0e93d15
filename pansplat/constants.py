"""Numbers that renderers and cameras share. GLSL gets them as defines, web pages in their header.

Source: docs/rendering.md.
"""

# Definition of an image.
ALPHA_CUT = 1 / 255  # smaller alphas count as zero: less than one step of an 8-bit image
MAX_ALPHA = 0.99  # keeps 1 - alpha, by which gradients divide, away from zero
FILTER_VARIANCE = 0.1  # pixel^2, added across the ray by the low-pass filter
EXPOSURE_WAY = 12**0.5  # way of a camera during an exposure, over the standard deviation of its place on it
EWA_DILATION = 0.3  # pixel^2: 3DGS adds it to the projected covariance
NEAR = 0.05  # metres, by default; Gaussians whose mean is nearer are not rasterised
EWA_NEAR_FACTOR = 0.2  # relative to `near`; 3DGS culls at this depth along the optical axis
EWA_CLAMP = 1.3  # half sides of the image; 3DGS evaluates its Jacobian no farther from the centre

# Early termination: a tile is finished once no pixel's transmittance exceeds this.
TRANSMITTANCE_CUT = {"numba": 1e-7, "triton": 1e-4}

# Rounding: every backend rasterises the same Gaussians, and gives gradients to the same ones.
ALPHA_CUT_ROUNDING = 1e-7  # relative; an alpha equal to the cut is kept
OPACITY_CUT = ALPHA_CUT * (1 - 1e-6)  # Gaussians of less opacity are removed before projection
KAPPA_MARGIN = 1e-5  # added to kappa, so that bounding boxes contain every pixel that reaches the cut
MAX_MAGNITUDE = 1e30  # products of larger parameters could overflow
MAX_SCALE_RATIO = 1e12  # scale over distance; beyond it the products of docs/rendering.md, section 2, could overflow
MIN_COMPENSATION = 1e-12  # least det B / det B'; it keeps the root differentiable, and below it alpha is always cut
MIN_EWA_VARIANCE = 1e-12  # pixel^2; the determinant of a needle can round to zero or less

# Cameras that a user moves.
MIN_FOV_DEGREES, MAX_FOV_DEGREES = 15.0, 130.0  # vertical
MAX_PITCH_DEGREES = 89.9
WALK_SPEED, FAST = 1.0, 4.0  # metres per second; the factor while Shift is held
