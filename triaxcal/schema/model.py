"""The base of the models of documents, the values that they have in common, and blocks
of figures that several documents have.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from typing import Annotated, Any, Literal, Self, TypeVar

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    PlainSerializer,
    ValidationError,
    ValidatorFunctionWrapHandler,
    WrapValidator,
)

E = TypeVar("E", bound=StrEnum)


def _as_given(value: Any, handler: ValidatorFunctionWrapHandler) -> float:
    """The value itself once it is found sound: pydantic would take
    `triaxcal.rounding.Printed` for a plain float, and an audit needs what it
    carries."""
    checked = handler(value)
    return value if isinstance(value, float) else checked


def _any_text(value: Any, handler: ValidatorFunctionWrapHandler) -> str:
    """With the surrogates that stand for bytes of a file name that are no
    UTF-8: pydantic would refuse them, and whoever shows or writes the text
    replaces them or says so."""
    return value if isinstance(value, str) else handler(value)


Text = Annotated[str, WrapValidator(_any_text)]
"""Text that may quote the name of a file or the words of a command."""
Figure = Annotated[float, WrapValidator(_as_given)]
"""A finite number, rounded as documents have it."""
Word = Annotated[E, Field(strict=False), PlainSerializer(str)]
"""A word out of a list. Documents hold it as text."""
Sha256 = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
Figures = list[Figure | None]
"""A number that does not exist is `null`."""
Vector = Annotated[list[Figure], Field(min_length=3, max_length=3)]
"""Of x, y, z."""
Matrix = Annotated[list[Vector], Field(min_length=3, max_length=3)]
"""Row by row."""


class Model(BaseModel):
    """A document or a part of one. The keys are in the order in which they are
    written; one that was not given is not written. Reading ignores keys that a
    later version added.

    A key with a default is one that documents of some kind, or of an earlier
    version, do without.
    """

    model_config = ConfigDict(frozen=True, strict=True, allow_inf_nan=False, defer_build=True)

    def document(self) -> dict[str, Any]:
        return self.model_dump(exclude_unset=True, by_alias=True)

    @classmethod
    def read(cls, value: object) -> Self | None:
        """None where the value, of JSON, is no such document."""
        try:
            return cls.model_validate(value) if isinstance(value, Mapping) else None
        except ValidationError:
            return None


# Blocks of figures that several documents have.


class Residual(Model):
    """Errors of the magnitude |a| in the poses, in the unit of the reference
    vector, for which g stands."""

    rms_g: Annotated[Figure | None, Field(description="rms of |a| − reference over the poses [g]")]
    max_abs_g: Annotated[Figure | None, Field(description="largest of them without its sign [g]")]
    cross_validated_rms_g: Annotated[
        Figure | None,
        Field(
            description="rms of each pose's error under a fit to the others [g]; "
            "`null` if a pose alone determines a parameter"
        ),
    ]
    noise_floor_g: Annotated[
        Figure | None,
        Field(
            description="rms of the standard errors of the pose means along the measured vector, from the scatter "
            "inside the poses, creep included [g]"
        ),
    ]
    lack_of_fit_p: Annotated[
        Figure | None, Field(description="probability of residuals this large by noise alone, 0…1")
    ]
    weighted_rms: Annotated[Figure | None, Field(description="rms of the residuals over their standard errors")] = None
    reduced_chi2: Annotated[
        Figure | None,
        Field(description="sum of the squares of the same over the degrees of freedom, about 1 for noise alone"),
    ] = None


class ByParameter(Model):
    scale_factor: Annotated[Figures, Field(description="of x, y, z [output/g]")]
    misalignment: Annotated[Figures, Field(description="of the three angles [rad]")]
    bias: Annotated[Figures, Field(description="of x, y, z [g]")]
    effects: Annotated[
        dict[Text, dict[Text, Figure | None]],
        Field(
            default_factory=dict,
            description="of each effect, by coefficient [unit of the coefficient]; absent without effects",
        ),
    ]


class OfMagnitude(Model):
    standard_g: Annotated[Figure | None, Field(description="standard uncertainty [g]")]
    coverage_factor: Annotated[Figure | None, Field(description="Student's t")]
    expanded_g: Annotated[Figure | None, Field(description="expanded uncertainty [g]")]


class BudgetLine(Model):
    source: Annotated[
        Text,
        Field(
            description="`noise`, `creep`, `lack_of_fit`, `reference`, `temperature`, `thermometer`, "
            "`choice_of_effect`, `register_rounding`, `not_held` (effects that registers lack); after `--rezero` also "
            "`kept` (the earlier calibration), `since` (changes between recordings), `scatter`"
        ),
    ]
    evaluation: Annotated[Literal["A", "B"], Field(description="`A` from scatter, else `B`")]
    degrees_of_freedom: Annotated[Figure | None, Field(description="degrees of freedom; `null` is infinite")]
    scale_factor: Annotated[Figures, Field(description="standard uncertainties of x, y, z [output/g]")]
    misalignment: Annotated[Figures, Field(description="standard uncertainties of the three angles [rad]")]
    bias: Annotated[Figures, Field(description="standard uncertainties of x, y, z [g]")]
    effects: Annotated[
        dict[Text, dict[Text, Figure | None]],
        Field(
            default_factory=dict,
            description="standard uncertainties by effect and coefficient; absent without effects",
        ),
    ]
    magnitude_g: Annotated[Figure | None, Field(description="standard uncertainty of |a| [g]")]
    share: Annotated[Figure | None, Field(description="share of the variance of |a|, 0…1")]
    how: Annotated[Text, Field(description="derivation in words")]
    assumes: Annotated[
        list[Text], Field(default_factory=list, description="effects whose size is assumed; absent without any")
    ]


class Uncertainty(Model):
    """Expanded uncertainties, and the budget that they come from."""

    level: Annotated[Figure, Field(description="level of confidence, 0.95")]
    expanded: Annotated[ByParameter, Field(description="expanded uncertainties of the parameters")]
    coverage_factor: Annotated[ByParameter, Field(description="Student's t of each parameter")]
    magnitude: Annotated[OfMagnitude, Field(description="of |a| over all orientations")]
    budget: Annotated[list[BudgetLine], Field(description="standard uncertainties by source, largest first")]
    dominant: Annotated[Text, Field(description="the largest source")]
    halved_by: Annotated[Text, Field(description="an action that halves it, in words")]
    magnitude_if_halved_g: Annotated[Figure | None, Field(description="standard uncertainty of |a| then [g]")]
    not_evaluated: Annotated[list[Text], Field(description="unknown sources, and what to state, in words")]
