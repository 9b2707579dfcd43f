"""The prior, and from which probability on something is said or done: the
settings of a diagnosis in one table, each with its reason."""

from __future__ import annotations

from dataclasses import dataclass

from triaxcal.effects.odds import EFFECT_ODDS, ON_ONE_AXIS, ON_TWO_AXES, SIZES, SMALLEST
from triaxcal.rounding import reaches


@dataclass(frozen=True)
class Odds:
    """Odds, probabilities and sizes before the poses were seen. A factor of 3
    in any of them changes little where the poses are many. An odds is that of a
    hypothesis with one more term over that without.

    Sizes are those of a whole effect: the rms of what it adds, over the sphere
    and over the recording's range of its covariate. They mean the same for
    every recording.
    """

    effect_odds: float = EFFECT_ODDS
    """That some effect of the catalogue acts, shared evenly among the names
    that can; a second one likewise."""
    pooled_effect_probability: float = 0.3
    """That one effect acts in every one of several units, shared likewise; else
    each unit is for itself."""
    outlier_odds: float = 0.005
    """That a pose is an outlier: one knock or slip in some two hundred."""
    unmodelled_probability: float = 0.2
    """That something acts that no name describes, shared evenly among its
    kinds."""
    local_probability: float = 0.001
    """That something acts near one end of an axis, or in one direction, shared
    among these: less than one outlier, so that a single pose stays one, and more
    than two, so that those that share a direction do not."""
    change_point_odds: float = 0.005
    """That one calibration does not hold in all poses: a unit exchanged, or its
    channels, in one of two hundred."""
    largest_g: float = 30e-3
    """A sensor that departs by more from the linear model is broken."""
    largest_outlier: float = 1.0
    """Of the reference, as of another unit or mounting: a pose that was moved,
    or turned over, is off by as much."""
    smallest: float = SMALLEST
    """Of the noise of a pose: what is less shows in no data."""
    sizes: int = SIZES
    """Steps between the two, even in the logarithm: a factor of 3 to 5, within
    which the evidence hardly changes."""
    unmodelled_smallest: float = 0.4
    unmodelled_largest: float = 200.0
    unmodelled_sizes: int = 7
    """Of an unmodelled part in standard errors of a pose: from what hardly
    shows to what no effect exceeds."""
    on_one_axis: float = ON_ONE_AXIS
    on_two_axes: float = ON_TWO_AXES
    """Of an effect with a part for each axis: usually, in the half that is
    left, one mechanism acts on all of them."""
    certain: float = 0.99
    """A name of this probability is adopted, and has to keep it without any one
    pose."""
    reported: float = 0.5
    """Outliers, and names that are not certain, are reported from this
    probability on."""
    refused: float = 0.5
    """Where an unmodelled part is likelier than not, or a name would be
    unlikelier than not without some one pose, no effect is corrected."""
    gain: float = 0.5
    """Of the expected mean square of |a| under the linear model. A correction
    that no name describes is not made where it leaves more. Half is a margin:
    no real sensor follows the assumed covariances exactly, and memory or time
    may look like a function of the direction."""
    gain_by_names: float = 0.7
    """Likewise of a correction by names none of which is certain. Of fifty
    recordings of 14 poses with an effect that no catalogue has, three came out
    worse, by up to five times, and all three expected more than this."""
    another_form: float = 0.2
    """Share of the mean square along the measured vector that is added across
    it, because another effect may look the same in |a|."""
    together: int = 3
    """Effects and outliers at once, at most."""
    relinearise_chi2: float = 1.0
    """Where the likeliest effects make more of chi-square by their curvature,
    all is linearised anew about them: so much changes no evidence by more than
    a factor of 1.6."""
    refine_share: float = 0.98
    """Where two neighbouring values of a shape hold so much of an effect's
    probability, each is divided: a normal distribution of more than a third of
    their distance has less there."""
    refine_count: int = 4
    """Values in the place of one."""
    window: float = 1e4
    """Sets of less probability than the best by this factor are left out
    (Occam's window; Madigan and Raftery 1994, J. Am. Stat. Assoc. 89:1535)."""

    def hangs_on_one_pose(self, probability: float) -> bool:
        """Whether a candidate of this probability would be certain, but for
        some one pose that may be an outlier."""
        return reaches(probability, self.certain)
