"""Every threshold by which a pad's alarms are raised, once, with its reason: sizes of what is left.

How sure it must be is in `core.rules`. What has no scores is observed, and compared with sound recordings.
"""

# What is left follows something.
FOLLOWS = 0.02
"""Part of the squared error that a descriptor must take away on recordings left out."""
FOLLOWS_IF_OWNED = 0.1
"""Part that no form of a family leaves to the descriptors of its own kind of effect."""
MIN_COURSE = 0.005
"""Deviation of gains along their course that is worth a word."""
MIN_RECORDINGS = 8
"""Recordings whose gains have a course."""

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
TAXEL = 6.0
"""Mean square of slow errors of one taxel while the pad is pressed, in variances of a frame's noise."""
OTHERS = 4.0
"""Factor by which it must exceed that of the taxel in the middle: errors of all are no taxel's."""
MIN_READINGS = 200
"""Readings that such a mean square must rest on."""

# What is left comes with sliding, or has a line.
SLIDING = 1.6
"""Mean square of whitened errors while sliding, over that of other readings under load; 1.2 is usual."""
AGREED = 1.2
"""The same within recordings, in their geometric mean: one that slides far may err more all the time."""
MIN_SLIDING, MIN_OWN = 60, 20
"""Sliding and still readings that there must be, in all and in a recording that is compared with itself."""
LINE_RATIO = 8.0
"""Power of a line over that around it, in the median of recordings, that noise does not reach."""
