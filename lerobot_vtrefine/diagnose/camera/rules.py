"""Every threshold of the camera's diagnosis, once, with its reason; the method's are in `core.rules`."""

POSE_LEAD = 0.02
"""A scale is one number, a pose six: part of the error by which a pose must do better."""
CUT_M, FIRST_CUT_M = 0.02, 0.08
"""Larger differences are something else than the camera, such as parts on the table; before the first step
the camera may be further off."""
EDGE_M = 0.004
"""Depth bends by more than this from pixel to pixel only where one surface ends."""
GRAZING = 0.2
"""Cosine between ray and normal below which a surface is seen at too flat an angle to compare depths."""
