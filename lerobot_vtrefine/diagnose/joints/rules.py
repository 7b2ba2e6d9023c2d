"""Every threshold of the joints' diagnosis, once, with its reason; about a single cause, its file has them.

How sure a decision must be is in `core.rules`. Differences of trials are measured in units of their scatter
from frame to frame.
"""

# What encoders resolve.
FEWEST_VALUES, FINEST_STEP, OFF_LATTICE = 8, 2e-6, 0.05
"""Different readings that show an encoder's step, the smallest step [rad, m] that is one, and how far from
whole numbers of it readings may be, in steps."""
MOST_DIFFERENT = 0.25
"""Part of an encoder's readings that differ from each other, below which its steps are coarse."""
LEAST_EFFECT_RAD, LEAST_EFFECT_M = 1e-4, 1e-5
"""Smallest change of the prediction (root mean square) that is worth a name."""

# A cause is accepted.
EXTRAPOLATION = (4.0, 8.0)
"""Largest size of a cause over the largest error seen: of several that may cancel, and of one alone."""
FORM_LEAD = 0.02
"""Part of the error by which a form with one more parameter must beat the plain one."""

# Measured loads decide between two causes.
LOAD_TELLS = 0.05
"""Part of the load's square that a model's servo torque must explain for loads to decide."""
SERVO_SHARE = 0.7
"""Part that it must explain for the load to be called the servo's own, and give friction its unit."""

# What is left repeats, or does not although the command does.
FEWEST_FRAMES = 8
"""Frames that two trials must share to be compared."""
MIN_REPEATED, FEW_REPEATED = 4, 2
"""Repeated conditions that are enough for `core.rules.REPEATS_ALL`, and that are enough for any alarm."""
NEARLY_ALL = 0.8
"""Part of what is left that must repeat in each of so few conditions."""
LEAST_PAIRS = 2
"""Pairs of trials of one command that show how far trials differ."""
SHAPES_DIFFER, RESTING_SHAPES_DIFFER, ZEROS_DIFFER = 5.0, 20.0, 12.0
"""Difference of trials of one command: slow noise makes up to three, a robot that is zeroed anew before every
trial up to eight in its zeros. Up to the second number, the difference must come with motion."""
SLOWEST, SETTLES = 0.2, 8
"""Part of the frames that count as slow, and frames for which a motion is felt."""
WITH_MOTION = 1.6
"""How much larger a difference is over all frames than over slow ones, if it comes with motion."""
SERVOS_DIFFER = 0.04
"""Part by which a servo's frequency may differ from trial to trial: batteries and oil, no fault."""

# What is left follows something, rings, or stands still.
FOLLOWS, FOLLOWS_IF_OWNED = 0.1, 0.4
"""Part of what is left that must follow a descriptor; more where the form of an accepted cause may be off."""
FEWEST_TRIALS, SESSION_TREND = 6, 0.1
"""Trials that show a trend, and the part of what is left that a straight line over the session must
explain."""
RINGS = 0.1
"""Part of what is left that must be in one line of its spectrum."""
CREEPS = 0.95
"""Damping ratio from which on a servo fades as two low-passes do: a third is told from neither."""
STANDS_STILL = 0.4
"""Part of the baseline's squared error in frames where a gripper stands far from its command."""

# Delays change from command to command.
DELAY_P = 0.05
"""Chance that a delay helps by accident, where all joints lag together anyhow."""
SHARED, NOT_AGAINST = 0.2, -0.1
"""Part of a joint's error that the other joints' lag must explain: of one in four joints, and of half. Noise
that joints do not share is made worse by each other's lag. Commands may come so rarely that joints of unequal
speed show little of one another's lag."""
EARLIEST, FURTHEST = 1.25, 2.5
"""Mean delays by which one command in a hundred may be early, and late: lost commands are later."""
TICKS_S = 5e-3
"""Deviation of single commands' delays up to which they are one: servos and hosts tick."""
MOST_ALIKE = 0.5
"""Correlation of the delays of commands next to each other, where those further apart have none: no more is
possible."""
LASTS_S, LASTING = 0.8, 0.5
"""Lags this far apart must not correlate by more than this, or it is the servo that is slow for a while."""

# What to record next.
ENOUGH_TRIALS = 8
"""Trials of one protocol: as many as sign flips need (`core.rules.FEW_TRIALS`)."""
TELLING = 3.0
"""Gap between two predictions, in units of the noise, that a handful of trials shows beyond doubt."""
