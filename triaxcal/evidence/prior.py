"""The prior, and the probabilities that decide: the settings of a diagnosis in one
table, each with its reason."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from triaxcal.effects.odds import EFFECT_ODDS, ON_ONE_AXIS, ON_TWO_AXES, SIZES, SMALLEST
from triaxcal.rounding import reaches


@dataclass(frozen=True)
class Odds:
    """Prior odds, probabilities and sizes. With many poses a factor of 3 in any of them
    changes little. The odds are those of a hypothesis with one more term against the
    hypothesis without.

    A size is that of a whole effect: the rms of its contribution over the sphere and
    over the recording's range of its covariate. It means the same in every recording.
    """

    effect_odds: float = EFFECT_ODDS
    """Odds that some effect of the catalogue acts, shared evenly among the possible
    names; also of a second effect."""
    of_effects: Mapping[str, float] = field(default_factory=dict)
    """Odds of single effects in place of their even share, learned from units of the
    type (`triaxcal.population`)."""
    pooled_effect_probability: float = 0.3
    """Probability that one effect acts in all of several units, shared among the
    possible names; otherwise the units are independent."""
    outlier_odds: float = 0.005
    """Odds that a pose is an outlier: one knock or slip in some two hundred."""
    unmodelled_probability: float = 0.2
    """Probability that an unmodelled part acts, shared evenly among its kinds."""
    local_probability: float = 0.001
    """Probability of a local part, near one end of an axis or in one direction, shared
    among these. It is less than that of one outlier, so a single pose stays an outlier,
    and more than that of two, so poses in one direction are a local part."""
    change_point_odds: float = 0.005
    """Odds that one calibration does not hold in all poses: in one of two hundred
    recordings somebody exchanges the unit or its channels."""
    largest_g: float = 30e-3
    """The largest effect: a sensor with a larger departure is broken."""
    largest_outlier: float = 1.0
    """The largest outlier or change of calibration, as a share of the reference: a
    pose that was moved or turned over has such an error."""
    smallest: float = SMALLEST
    """The smallest effect, in noises of a pose: no data show a smaller one."""
    sizes: int = SIZES
    """Number of sizes between both, even in the logarithm: steps by a factor of 3 to 5,
    within which the evidence hardly changes."""
    unmodelled_smallest: float = 0.4
    unmodelled_largest: float = 200.0
    unmodelled_sizes: int = 7
    """Sizes of an unmodelled part, in standard errors of a pose: from a hardly visible
    one to one that no effect exceeds."""
    on_one_axis: float = ON_ONE_AXIS
    on_two_axes: float = ON_TWO_AXES
    """Probabilities for an effect with a part for each axis. In the remaining half one
    mechanism acts on all axes, as is usual."""
    certain: float = 0.99
    """Probability from which on a name is adopted. It must keep this probability
    without any single pose."""
    reported: float = 0.5
    """Probability from which on outliers and uncertain names are reported."""
    refused: float = 0.5
    """No effect is corrected if an unmodelled part is more likely than this, or if a
    name would be less likely without some single pose."""
    gain: float = 0.5
    """Largest share of the expected mean square of |a| under the linear model that a
    correction without a name may leave. Half is a margin: no real sensor follows the
    assumed covariances exactly, and memory or time may look like a function of the
    direction."""
    gain_by_names: float = 0.7
    """The same share for a correction by uncertain names. Of fifty recordings of 14
    poses with an effect outside every catalogue, the correction made three worse, by
    up to five times; all three expected more than this share."""
    another_form: float = 0.2
    """Share of the mean square along the measured vector that is added across it:
    another effect may look the same in |a|."""
    together: int = 3
    """Maximum number of effects and outliers in a hypothesis."""
    relinearise_chi2: float = 1.0
    """Change of chi-square by the curvature of the likeliest effects from which on the
    data are linearised again about them: this much changes no evidence by more than a
    factor of 1.6."""
    refine_share: float = 0.98
    """Share of an effect's probability in two neighbouring values of its shape from
    which on both are refined: a normal distribution with a standard deviation of more
    than a third of their distance has less there."""
    refine_count: int = 4
    """Number of values that replace one."""
    window: float = 1e4
    """Sets that are less probable than the best by this factor are excluded (Occam's
    window; Madigan and Raftery 1994, J. Am. Stat. Assoc. 89:1535)."""

    def of_effect(self, name: str, count: int) -> float:
        """Odds that an effect acts, one of ``count`` possible names."""
        return self.of_effects.get(name, self.effect_odds / max(count, 1))

    def hangs_on_one_pose(self, probability: float) -> bool:
        """Whether a candidate of this probability would be certain without some single
        pose, which may be an outlier."""
        return reaches(probability, self.certain)
