"""Every threshold of the method, once, with its reason."""

ALPHA = 0.02
"""Chance that trials without any effect yield a name, over all candidates and channels together."""
SUSPICION_ALPHA = 0.01
"""Chance that trials without any effect raise an alarm, over all suspicions of a test and all channels."""
BALANCED_AT = 0.001
"""Tail of every suspicion's own resampled values that is its unit: far out, where the joint test decides, and
still ten of `FLIPS`."""
LEAST_GAIN = 0.01
"""Smallest part of a channel's squared error that is worth a name: below, no user would notice."""
LEAST_UNKNOWN = 0.02
"""Smallest part of the baseline's squared error for which something without a name is worth an alarm: twice
what a name needs, for a name says what to do and an alarm only that something is to be done."""
AS_GOOD = 1.02
"""Cross-validated error of one cause over that of several, up to which the one is enough."""
MAX_ROUNDS = 4
"""Causes that one channel may have. Five trials in six that reach a fifth explain noise."""
FOLDS = 5
"""Parts that trials are cross-validated in: a fit to four fifths is nearly the fit to all."""
MIN_CONDITIONS = 4
"""With fewer conditions than this, trials are left out one by one where conditions would be."""
FLIPS = 9999
"""Random sign flips; p-values are then known to a tenth of `ALPHA`."""
EXACT_UP_TO = 13
"""Trials up to which all sign flips are tried: 2^13 are fewer than `FLIPS`."""
DRAWS = 2000
"""Draws of whole trials for the interval of a gain."""

TIE_P = 0.1
"""Above this, trials do not prefer one of two models."""
TIE_LEAD, SURE_P = 0.03, 0.01
"""Where two models' cross-validated errors differ by less, trials must prefer one of them more surely: forms
that are not quite right differ by as much."""
SHARE_OF_GAIN = 0.9
"""Part of a cause's gain that another must reach to be its rival, and of a decoy's that a name must reach."""
DECOY_LEAD, DECOY_P = 0.05, 0.01
"""By how much, and how surely, a decoy must beat every name: names are believed first."""
HELPED = 0.5
"""Part of `LEAST_GAIN` by which a plainer cause must have helped for a slower one like it to be tried."""

LOCKED_SHARE = 0.25
"""Part of the recordings that is locked away for the final number."""
MIN_DISCOVERY = 3
"""Recordings that are left for discovery, whatever is locked."""
WHOLE_CONDITIONS_FROM = 6
"""Number of conditions from which on whole conditions are locked as well."""

SURE = 3.2 + 0.84
"""Standard errors at which four in five searches find an effect, all candidates considered."""
UNSEEN = 0.05
"""Part of an effect that the baseline's own parameters must not be able to do for it to be identifiable."""
FEW_TRIALS = 8
"""With fewer trials than this no sign flips can be significant over a catalogue of candidates."""
CLEARLY_HELPS = 0.25
"""Gain on trials left out by which a cause is spoken of where trials are too few for any test."""

SCREEN_ALPHA = 0.05
"""Chance that any candidate passes a score test where none is there; it must then predict better, too."""
SCREEN_SHARES = {"scores": 0.8, "products": 0.2}
"""Parts of that error rate that kinds of score tests get; where one is missing, the others share its part."""
FEW_FOR_SIGNS = 10
"""With fewer trials than this that have a say, signs alone cannot pass a score test: size counts as well."""
SIZE_DOUBT = 2.0
"""Factor by which scores may stray more than the fitted noise says, where their size counts."""
CARRIED = 0.9
"""Part of all that trials say which those that carry it make up."""
FITTED = 6
"""Candidates that pass the score test and are fitted in a round, the most promising ones."""
AGREEMENT_P = 0.05
"""Chance that what passed the test predicts as many trials left out better, if there were nothing."""
FORM_P = 0.01
"""Chance that another form of a settled name predicts trials left out likelier, if it were no better."""
PROMISING = 0.4
"""Part of the best candidate's gain that a cause's plain form must reach for its other forms to be tried."""
RICH = 2
"""Coordinates of a form from which on it imitates other causes."""
NEARLY = 0.6
"""Part of a named cause's gain that a rival's plain form must reach for its other forms to be tried."""
DOUBTFUL_GAIN, DOUBTFUL_P = 0.03, 0.01
"""What symptoms must take away of the cross-validated squared error, and how surely, to be handed out."""

# Positions that encoders read, of joints and of single servos.
REPEATS, REPEATS_ALL = 0.3, 0.6
"""Part of what is left that must repeat with the command; where it is the larger one, in every condition,
these need not be enough for a small p."""
RESOLVED = 0.25
"""Part of an encoder's step that means over many readings resolve."""
