"""Every threshold by which recordings are repaired or set aside, once, with its reason.

Checks must not take a pad's or a robot's own flaws for broken recordings.
"""

# How much must be sound.
MIN_TRIALS = 4
"""Fewer leave none for choosing beside those that are held out."""
MIN_PART = 1 / 3
"""If less than this part of a set is sound, the rest is not trusted either."""
MINORITY = 0.5
"""A fault of fewer trials than this part of the set is theirs; of more, it is a property of the rig."""

# Frames and clocks.
MAX_BROKEN = 0.1
"""A trial with a larger part of frames without numbers is set aside."""
MIN_FRAMES = 10
"""Shorter trials carry no rates and no history."""
GAP, MAX_GAP_S, MAX_MISSING = 1.75, 0.5, 0.2
"""A step longer than the first, times the usual one, has lost frames. Over a gap longer than the second, what
happened to the pad is unknown; a trial that lost a larger part of its frames than the third is set aside."""
FEW_SPIKES, SPIKE_FAR, LEAST_MOTION_M = 0.02, 1.0, 1e-4
"""Part of the frames that may be spikes, for more are a motion or another unit; a spike lies beyond all other
frames by this many times their whole range, which counts as this long at least."""

# Units.
PITCH_M, INDENTER_M = (5e-5, 0.1), (5e-5, 0.5)
"""Smallest and largest distance of taxels that is plausible (skins of chips, and mats to stand on), and of
radii, sides and meshes of indenters."""
COARSEST_MM = 0.4
"""Numbers between the limit in metres and this one may be centimetres as well as millimetres."""
PLACES_M = 0.3
"""No indenter that presses a pad is further than this from its centre."""
STILL_M = 2e-5
"""A depth that varies less than this in a whole trial is not a press: its zero was wrong, not its unit."""
ROOM_C = (-60.0, 150.0)
"""Temperatures [deg C] that a pad may have."""
SLOWEST_STEP_S, SHORT_STEP_S = 3.0, 1.0
"""Frames further apart are taken for another unit of time; in the right one they are not as far apart."""
CROWDED, CROWDED_STEP_S = 1.5, 0.3
"""Trials that last longer than so many times the time between their starts cannot be in seconds, if their
frames are further apart than this."""
FAR_START_S = 10.0
"""A first frame later than this, and than the trial is long, was not timed from the trial's start."""

# The session.
OVERLAP_S, OVERLAP = 0.5, 0.02
"""Trials may seem to overlap by this much, and this part of their length, from rounding."""
LONG_PAUSE = 100.0
"""Lengths of a trial between starts, beyond which (and beyond an hour) starts are in another unit."""
ALIKE, SAME_PLACE_M = 0.25, 1e-3
"""Root mean square difference of trials that were not driven alike, in parts of their range; places that
differ by this part of the second length, or of two taxels, are the same."""

# Contact, and what drives a pad.
CLEAR_M = 2e-4
"""An indenter this far above the face surely does not touch it."""
TOUCH_FORCE = 0.05
"""Part of a trial's peak force above which it counts as loaded."""
ALONG, CLEARLY, UNRELATED = 0.5, 0.3, 0.2
"""Correlation with the response that depth or force must reach with its sign inverted, and by how much more
than as recorded; and below which a force does not follow the press."""
LATE_S = 0.5
"""Readings that come this late still follow the press."""
CLEAR_SIZE, CLEAR_PART = 8.0, 0.02
"""A response is clear if it is this many deviations of a frame's noise and this part of full scale."""
HEAVY_N = 150.0
"""Pads and their indenters are pressed with some tens of newtons."""
TARE = 0.1
"""Part of the peak force that a load cell shows at rest if it was not zeroed."""

# Scale of readings.
HARDLY, BEYOND = 0.02, 1.01
"""Parts of full scale: readings that stay below the first through a whole set, or exceed the second (rounding
aside), are in another unit."""
BELOW, TOUCHED_BELOW = 0.05, 0.5 / 255.0
"""Parts of full scale below zero that mean that an idle level was subtracted, and that no converter gives."""
WRAP, MIN_WRAPS = 0.7, 2
"""Fall within a frame, in parts of full scale, that no release under rising load makes, and how often."""
LIGHT, ALWAYS, ONE_TAXEL = 0.05, 0.95, 0.7
"""Readings are scaled frame by frame where of the frames above the first part of the peak load the second
part has the same largest reading, unless one stuck taxel has it in the third part of them."""

# The pad's response.
DRIVEN, LOADED, TINY_M = 0.1, 0.2, 5e-5
"""Parts of a trial's peak, in drive and in readings, that are too much for its first frame; rigs find the
face with an error of the last number, so that touching so lightly is not a loaded start."""
NO_ANSWER = 0.03
"""Slope of reading over drive, relative to the usual one, below which a trial shows no response."""
DEAD, ALIVE = 0.05, 0.5
"""The same of channels that do not respond in a trial, and that do in others."""
STUCK = 0.98
"""Part of a trial's frames at full scale."""

# Wiring.
BETTER_ORDER = 0.4
"""Another order of lines or joints must leave less than this part of the error ..."""
MISWIRED, EXCHANGED = 0.1, 0.5
"""... and the recorded one more than this: part of a pad's signal, or 1 - correlation with the own
command."""
MIN_IDLE_SPREAD = 3.0
"""Idle maps identify lines only if taxels differ by this many deviations of the map's own noise ..."""
BEYOND_NOISE = 3.0
"""... and a map is another one's only if it differs by this many times the square that noise makes."""
STRAY = 0.1
"""Misplaced lines show at least this part of the signal where nothing presses; dead ones do not."""

# Trials that differ from all others.
STRANGE, USUAL = 0.5, 0.2
"""Part of a trial's readings that is not in proportion to its drive: in an odd one, and in most."""
APART = 2.0
"""A trial's replicates must be this many times better, for a motion may be hard to predict by itself."""
APART_GAIN, USUAL_GAIN = 0.3, 0.05
"""Logarithm by which a trial's reading per drive is off, and what that of its set usually is."""
FEW = 0.1
"""Part of the trials that may be off; more are a property of the rig."""
MIN_KNOWN = 6
"""Trials with replicates that it takes to know what is usual."""
MIN_SHARE = 0.1
"""Trials with less than this part of the usual power say too little."""

# Encoders.
MOVES, STILL = 0.1, 1e-3
"""A joint moves in a trial if its command's range is this part of its largest range in the set; an encoder
sticks if its range is below this part of the command's."""
SWAP_SHOWS = 5e-3
"""Commands must move joints this far [rad, m] for encoders to be told as swapped: a hand that only
holds a part is moved by its load as much as by commands, in any direction."""
JUMP_RAD = 1.0
"""No joint moves further between two frames, unless its command does."""
COARSE_RAD = 5e-3
"""Steps of an encoder [rad, m] from which on they are told: three of the usual 4096 a turn."""
