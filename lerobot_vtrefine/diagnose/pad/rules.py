"""Every threshold by which a pad's causes are accepted and its alarms are raised, once, with its reason.

How sure a decision must be is in `core.rules`. Alarms are raised by the size of what is left; what has no
scores is observed, and compared with sound recordings.
"""

# A search sees some of the frames.
ENOUGH_HZ = 30.0
"""Frames per second that a search sees at least, where there are as many."""
ENOUGH_READINGS = 40_000
"""Readings from which on frames are left out: more cost time, and tell the search nothing new."""
FEW_REPEATS = 0.005
"""Share of repeated frames up to which they repeat by chance."""

# A cause is accepted.
FURTHER_GAIN = 0.025
"""Part of the squared error that a cause beside the first must take away: patching the first's form gains a
little, too."""
MORE_COORDINATES = 2
"""Coordinates that another form may have beyond the named one's, to be tried once names are settled."""
HINGE_REACH = 0.5
"""Part of the rows, and of the columns, that must be pressed for a hinge to be tried: along a strip it lifts
all places alike, as an offset does."""
FORGIVEN = 1.5
"""Factor by which weights may raise the plain squared error of a model; beyond, all readings count alike."""
FAR_OFF = 4.0
"""Mean square of slow errors under load, in variances of a frame's noise, that weights must not hide."""
COMMON = 1.0
"""Deviations between taxels' own contact offsets that the mean must exceed to be the pad's: then five taxels
in six deviate to its side."""
DEAD_BELOW, DEAD_ERRORS = 1 / 3, 2.0
"""Part of the median gain below which a taxel is dead (that it reads nothing takes away three quarters of its
squared error), and the standard errors by which its gain must lie below."""
MAYBE_DEAD_ERRORS = 1.0
"""Standard errors that are enough for one more dead taxel, where others are."""
SHIFT_TAXELS, LOWER_PART, PITCH_STEP, SIZE_STEP = 0.5, 0.2, 0.1, 0.15
"""Steps in which other geometries are tried: an object's shift in taxels, the face's height in parts of the
deepest press, logarithms of the pitch and of an object's size."""
MOST_GEOMETRY = 3.0
"""Steps up to which a geometry may be other than stated."""
MORE_GEOMETRY, GEOMETRY_GAIN = 0.2, 0.25
"""Part of the squared error that one more kind of geometry must take away, and that all together must on
presses left out, of what is left by the stated one and by names. Causes on a right geometry leave them .1 and
none, but for leaks one way that are strong: .2, and none left out."""
WITNESSES = 2
"""Locked recordings that must each show a taxel to be dead that others do not press: one tells the other."""

# Readings are held.
MIN_HELD, CHANCE = 0.005, 0.2
"""Share of frames that must repeat the one before for readings to be held, and the part of it that may be
chance: a stream that freezes for moments repeats one frame in a hundred, noise of many taxels none."""
HELD_ROWS = 0.05
"""The same share of single rows, where whole frames are not held."""
VISIBLE = 0.01
"""Part of a press's deepest drive by which it must change for a repeat to tell."""
MANY_TAXELS = 6
"""Taxels from which on each says how often the others repeat by chance."""
SURE_MOVE = 4.0
"""Deviations of noise by which the motion alone must change readings of fewer taxels for a repeat to tell."""
MIN_TELLING = 10
"""Frames that such a share must rest on."""
MIN_REPEATED = 0.1
"""Share of frames that must repeat the one before for a rhythm to be looked for."""
RARITY = 0.08
"""Part by which the mean time between new readings may be off as a period."""
CONTRADICTED = 0.1
"""Share of changes where a rhythm wants none, up to which it is believed; of repeats where it wants a change,
three times as much, for readings may stay what they were."""

# What is left follows something.
FOLLOWS = 0.02
"""Part of the squared error that a descriptor must take away on recordings left out."""
FOLLOWS_IF_OWNED = 0.1
"""Part that no form of a family leaves to the descriptors of its own kind of effect."""
MIN_COURSE = 0.005
"""Deviation of gains along their course that is worth a word."""
MIN_RECORDINGS = 8
"""Recordings whose gains, or delays, have a course."""
DELAY_COURSE = 0.5
"""Part of the variance of recordings' own delays that follows the session: most of it is then no chance."""

SIZES_DIFFER = 0.25
"""Deviation of a cause's size between recordings, in parts of it: other forms than the sensor's leave up to a
sixth, borrowed names a third and more."""
OWN_SHARE = 0.25
"""Part of a cause's effect that a recording's own gain and touch must leave: else its size is theirs."""

# What is left repeats with the command.
REPEATABLE_SHARE = 0.15
"""Part of what is left that must repeat."""
MIN_AGREEING = 4
"""Conditions that must agree without exception for what repeats to be believed without a test."""
MIN_RMS = 0.4 / 255.0
"""Repeatable residual below this part of full scale may be the converter's rounding."""
MISFIT, MISFIT_NOISE = 0.1, 1.0 / 3.0
"""Parts of the baseline's repeatable squared error, and of the squared error that is left, up to which what
still repeats is laid to the names' form. Effects outside the catalogue that borrow names leave a fifth."""
PAIR_CORRELATION, PAIR_DEVIATIONS = 0.2, 6.0
"""Correlation of the replicates of one condition, and its distance from strangers' in their deviations."""
MIN_STRANGERS = 30
"""Pairs of recordings of different commands that say how far strangers scatter."""
PAIRS, PAIRS_LEFT, PAIRS_MISFIT = (0.15, 5.0), (0.1, 2.8), (0.2, 5.0)
"""Mean correlation of all replicates, and its distance from strangers' in standard errors, that mean an
unknown cause: without a name, beside names that leave much, and beside names that leave little. Site effects
that replicates share bring .08 and 3.5, three times the usual scatter .13."""
LEFT = 0.25
"""Part of what repeats that names of true causes, in whatever form, do not leave."""

# What is left is far above the noise of single frames.
LEVEL = 4.0
"""Mean square of slow errors under load, in variances of a frame's noise, that is no misfit of a form."""
CONDITION_LEVEL = 2.5
"""The same in all recordings of one condition; clean ones reach 1."""
BESIDE = 1.15
"""Mean square of whitened errors of taxels beside a pressed indenter, over that at rest; 1.06 is usual."""
TAXEL = 12.0
"""Mean square of slow errors of one taxel in one recording under pressure, in variances of a frame's noise:
three times what noise that wanders for seconds reaches."""
MOST, OTHERS = 0.9, 1.5
"""Quantile of all such mean squares, which tells their scale: errors of all are no taxel's. A failing taxel's
exceeds the largest usual one of so many squares of normal numbers by this factor, as levels that noise, gains
and first touches leave are only nearly normal."""
FAILING = 0.25
"""Product of the differences of a taxel's white errors in replicates, a few frames apart, in variances of
noise, that is worth an alarm: taxels that fail now and then reach .4 to 3, others .3 in a single pair."""
MIN_READINGS = 200
"""Readings that such a mean square must rest on."""
MIN_PRESSED = 50
"""Frames that one taxel's must rest on."""

# What is left is shared by taxels.
LOWEST_HZ, HIGHEST_HZ = 2.0, 65.0
"""Frequencies at which taxels may hum: slower is a press's own motion, or what it is not quite told by; the
fastest mains have 60 Hz, and the times of frames are not known well enough for more."""
GROUPS = 8
"""Groups of taxels whose hum is compared: their sums hold seven eighths of what all pairs of taxels say."""
MIN_RESTING = 5
"""Frames at rest that a recording's idle levels rest on."""

# What is left comes with sliding.
SLIDING = 1.6
"""Mean square of whitened errors while sliding, over that of other readings under load; 1.2 is usual."""
AGREED = 1.2
"""The same within recordings, in their geometric mean: one that slides far may err more all the time."""
MIN_SLIDING, MIN_OWN = 60, 20
"""Sliding and still readings that there must be, in all and in a recording that is compared with itself."""
