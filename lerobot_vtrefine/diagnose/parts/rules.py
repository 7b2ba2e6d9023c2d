"""Every threshold of the parts' diagnosis, once, with its reason; the method's are in `core.rules`."""

# A number differs from what is assumed.
BEYOND = 2.0
"""Standard errors, and multiples of the method's own error, by which a number must differ."""
MASS_ERROR, FRICTION_ERROR, CLEARANCE_ERROR = (0.06, 0.004), (0.1, 0.02), (0.03, 6e-5)
"""The method's error on the twin's own recordings: part of the value, and at least so much [kg, 1,
m]."""
MIN_EPISODES = 3
"""Episodes that must show a number: two that disagree would not say which is right."""

# What pads and hands say about an episode.
TOUCHED_COUNTS = 8
"""A taxel this much above its idle level is pressed."""
HELD_TAXELS = 6
"""A pad with at least so many pressed taxels holds something, if its opposite does, too."""
LIFTED_M, CLEAR_M = 0.0015, 0.02
"""Height from which on a raised part hangs in the hand, and from which on it surely touches nothing else."""
APART_M, SIDEWAYS_M = 0.012, 0.04
"""Height between the parts' mouths, and distance beside each other, beyond which parts do not touch."""
SETTLE_S = 1.0
"""Time after a touch, or after a part has left the table, in which servos are still recovering."""

# Mass.
AGAIN = 0.2
"""A mass that is off by more than this part is estimated again from where it was found."""
TELLING_KG = 0.04
"""A joint counts if its own estimate's standard error is below this."""
MIN_JOINTS = 2
"""Joints that must agree: a fault of one joint looks like a mass on that joint alone."""
DISAGREE = 0.25
"""Joints agree where their estimates differ from the common one by less than this part of it, or by
chance."""

# Friction.
PRESS_N, SLIDES_M_S, FLAT_M = 1.5, 0.02, 0.008
"""The plug slides under load: force on the table, speed, and distance of its tip from the table."""
MIN_SLIDING = 5
"""Frames of an episode in which it must."""

# Clearance.
PUSH_N = 0.12
"""Sideways force of a wall on the plug."""
INSERTED_M = 0.006
"""The plug's tip is this far below the mouth; how high a part is held may be off by half of it."""
RESTS_M_S = 0.003
"""A plug at a wall moves no faster; on its way between the walls arms lag, which is no push."""
MIN_ON_A_WALL = 3
"""Frames on each wall."""
